"""The server's limits of light for the domes that its jobs capture with.

They hold whatever a job asks for, because a person's face is in the dome.
"""

from __future__ import annotations

from datetime import UTC, datetime

from services.core.errors import ExposureLimitError, SettingsError
from services.core.records import LOWERED_LIMITS, JobSpec, RigSpec
from services.core.settings import DomeSettings

_PREFIX = "DENTINE__SERVER__DOME__"


class LightLimits:
    """The server's limits for every dome that its jobs capture with."""

    def __init__(self, settings: DomeSettings) -> None:
        self._settings = settings

    def require(self, rig: RigSpec) -> None:
        """Refuse a rig that the server does not allow, before anything is connected to or lit.

        Raises:
            SettingsError: its dome, level, exposure or rate of flashes is not allowed. ExposureLimitError: one of its
                exposures is over the largest dose of one light.
        """
        settings = self._settings
        if rig.dome not in settings.allowed_addresses:
            known = ", ".join(sorted(settings.allowed_addresses))
            what = f"Option 'rig.dome': this server captures with {known} and not with {rig.dome}"
            raise SettingsError(f"{what}; name one of them, or have {_PREFIX}JOB_ADDRESSES name this one.")
        if rig.level > settings.max_level:
            what = (
                f"Option 'rig.level': {rig.level:g} is above this server's {settings.max_level:g} ({_PREFIX}MAX_LEVEL)"
            )
            raise SettingsError(f"{what}; lower it.")
        on_s = rig.settle_s + rig.exposure_s
        if on_s > settings.max_exposure_s:
            what = (
                f"Option 'rig.exposure_s': {on_s:g} s with 'rig.settle_s' are longer than this server's"
                f" {settings.max_exposure_s:g} s"
            )
            raise SettingsError(f"{what} ({_PREFIX}MAX_EXPOSURE_S); shorten them.")
        if rig.flashes is not None and rig.flashes.per_s > settings.max_flashes_per_s:
            what = (
                f"Option 'rig.flashes.per_s': {rig.flashes.per_s:g} flashes a second are more than this server's"
                f" {settings.max_flashes_per_s:g} ({_PREFIX}MAX_FLASHES_PER_S)"
            )
            raise SettingsError(f"{what}; lower it.")
        dose_s, limit_s = rig.level * on_s, min(rig.light_exposure_limit_s, settings.light_exposure_limit_s)
        if dose_s > limit_s:
            what = (
                f"One exposure at rig.level {rig.level:g} for {on_s:g} s is {dose_s:.3g} level-seconds, over the limit"
                f" of {limit_s:g} of one light"
            )
            raise ExposureLimitError(f"{what}; lower rig.level or rig.exposure_s.")

    def lowered(self, spec: JobSpec) -> JobSpec:
        """Return a job's options with the limits of its rig lowered to the server's where they were higher.

        Raises:
            SettingsError, ExposureLimitError: as ``require``, for a job that was accepted under other settings.
        """
        if spec.rig is None:
            return spec
        self.require(spec.rig)
        limits = {name: min(getattr(spec.rig, name), getattr(self._settings, name)) for name in LOWERED_LIMITS}
        limits["assessment"] = spec.rig.assessment or self._settings.assessment
        return spec.model_copy(update={"rig": spec.rig.model_copy(update=limits)})


def require_recent(rig: RigSpec) -> None:
    """Refuse a rig whose acknowledgement of faster flashes is older than a day now, before its job waits in vain.

    Raises:
        SettingsError: the acknowledgement does not hold.
    """
    if rig.flashes is not None and not rig.is_simulated:
        rig.flashes.require_recent(datetime.now(UTC))
