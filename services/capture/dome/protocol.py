"""Protocol of the dome that a capture uses, and the exposure budget that every dome enforces."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self

from services.core.dome import DomeStatus
from services.core.errors import ExposureLimitError

Rgb = tuple[int, int, int]


class Dome(Protocol):
    """A dome of lights around a face. When an exception reaches the caller, the lights are dark."""

    @property
    def light_count(self) -> int:
        """Number of lights fitted."""

    @property
    def flash_interval_s(self) -> float:
        """Shortest time in s between two lights; 0 where the dome is simulated."""

    def light(self, index: int | None, level: float, on_s: float) -> Rgb:
        """Switch on one light, or all for None, and every other off; return the levels read back.

        It waits, in the dark, until the light may go on without flashing too often.

        Args:
            index: index of the light; None for all lights.
            level: fraction of full scale, the same for R, G and B.
            on_s: planned on-time in seconds, counted against the exposure limits before anything is sent.

        Raises:
            ExposureLimitError, InterlockError, ReadbackError, RigError. SettingsError: the acknowledgement of a
                higher rate of flashes is too old.
        """

    def confirm(self) -> Rgb:
        """Check that exactly the commanded light is emitting; return the levels read back."""

    def trigger(self) -> None:
        """Pulse the cameras' trigger line."""

    def dark(self) -> None:
        """Switch off every light and check it."""

    def pause(self, seconds: float) -> None:
        """Wait with the light unchanged; when ``interrupt`` is called meanwhile, raise its exception at once."""

    def interrupt(self, reason: Exception) -> None:
        """Go dark at once; any thread may call it.

        The thread that drives the dome gets no further light; its next call raises ``reason``.
        """

    def status(self) -> DomeStatus:
        """Read the controller's state."""

    def __enter__(self) -> Self:
        """Connect, check safety, arm the watchdog."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Go dark, whatever happened."""


@dataclass
class ExposureBudget:
    """Light dose so far and its limits, in level-seconds: level (fraction of full scale) times on-time in seconds.

    Both limits follow from the rig's photobiological assessment (IEC 62471): radiance dose of one source, and of all.

    Attributes:
        light_limit_s: largest dose of one light.
        total_limit_s: largest dose of all lights together.
        spent_s: dose of each light so far, by its index.
    """

    light_limit_s: float
    total_limit_s: float
    spent_s: dict[int, float] = field(default_factory=dict)

    def require(self, lights: range, level: float, on_s: float) -> None:
        """Refuse a dose that would exceed a limit.

        Raises:
            ExposureLimitError: a limit would be exceeded; the message names the dose, the limit and the light.
        """
        dose_s = level * on_s
        worst = max(lights, key=lambda light: self.spent_s.get(light, 0.0))
        light_s = self.spent_s.get(worst, 0.0) + dose_s
        total_s = sum(self.spent_s.values()) + dose_s * len(lights)
        if light_s > self.light_limit_s:
            raise ExposureLimitError(
                f"Light {worst} would reach {light_s:.3g} level-seconds, over its limit of {self.light_limit_s:g};"
                " lower rig.level or rig.exposure_s."
            )
        if total_s > self.total_limit_s:
            raise ExposureLimitError(
                f"All lights together would reach {total_s:.3g} level-seconds, over the limit of"
                f" {self.total_limit_s:g}; lower rig.level or rig.exposure_s, or use fewer lights."
            )

    def spend(self, lights: range, level: float, on_s: float) -> None:
        """Record light that was emitted."""
        for light in lights:
            self.spent_s[light] = self.spent_s.get(light, 0.0) + level * on_s
