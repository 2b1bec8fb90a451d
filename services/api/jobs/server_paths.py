"""Which folders of the server and which S3 stores a job may name.

The folders are those below the roots that the settings allow, and none where callers need tokens and no root is set.
The stores are, on every server, those that the settings name and those below them: otherwise whoever submits a job
would choose where the server's own credentials write.
"""

from __future__ import annotations

import re
from pathlib import Path

from services.core.errors import SettingsError
from services.core.files.server_faults import require_library
from services.core.files.store_url import STORE_URL
from services.core.records import JobSpec
from services.core.settings import ServerSettings

SETTING = "DENTINE__SERVER__JOB_ROOTS"
STORES_SETTING = "DENTINE__SERVER__STORES"


class ServerStores:
    """The S3 stores that a server's jobs may name.

    Raises:
        SettingsError: a setting is not the URL of a store. PlatformError: stores are set, and the package that speaks
            to S3 servers is not installed.
    """

    def __init__(self, settings: ServerSettings) -> None:
        self._allowed = tuple(one.strip() for one in settings.stores.split(",") if one.strip())
        if wrong := next((one for one in self._allowed if not re.fullmatch(STORE_URL, one)), None):
            raise SettingsError(
                f"Setting {STORES_SETTING}: {wrong} is no s3://BUCKET/PREFIX without a slash at its end; correct it."
            )
        if self._allowed:
            require_library()

    def require(self, spec: JobSpec) -> None:
        """Refuse a job whose store is not allowed, before anything is connected to.

        Raises:
            SettingsError: the store is not allowed.
        """
        if spec.store is not None and not any(f"{spec.store}/".startswith(f"{one}/") for one in self._allowed):
            known = ", ".join(self._allowed) or "none"
            raise SettingsError(
                f"Option 'store': this server does not keep what jobs prepare at {spec.store}, but below: {known}; "
                f"name one of them or leave the option out, or have {STORES_SETTING} name this one."
            )


class ServerPaths:
    """The paths that a server's jobs may name.

    Args:
        roots: folders below which the paths must lie; None allows any path.
        data: the server's own folder. Where there are roots, nothing in it may be named, because it holds what belongs
            to others.

    Raises:
        SettingsError: a root is not absolute.
    """

    def __init__(self, roots: tuple[Path, ...] | None, data: Path) -> None:
        if relative := next((root for root in roots or () if not root.is_absolute()), None):
            raise SettingsError(
                f"Setting {SETTING}: {relative} is relative; give absolute folders, separated by commas."
            )
        self._roots = None if roots is None else tuple(root.resolve() for root in roots)
        self._data = data.resolve()

    @classmethod
    def of(cls, settings: ServerSettings) -> ServerPaths:
        """Create the check from the settings."""
        named = tuple(Path(one.strip()) for one in settings.job_roots.split(",") if one.strip())
        return cls(None if settings.access == "open" and not named else named, settings.data)

    def require(self, option: str, path: Path, remedy: str = "check the path") -> None:
        """Refuse a path that is relative, not allowed or absent; ``remedy`` says what to do about an absent one.

        A path that is not allowed is refused in the same words whether it exists or not.

        Raises:
            SettingsError: it is relative, lies below no root, or is absent.
        """
        if not path.is_absolute():
            raise SettingsError(f"Option '{option}': {path} is relative; give the absolute path on the server.")
        resolved = _resolved(path)
        if self._roots is not None and (resolved is None or not self._is_allowed(resolved)):
            what = f"Option '{option}': this server takes no folder of its own there"
            raise SettingsError(
                f"{what}; upload it, with dentine submit --upload or in the page, or have {SETTING} name its root."
            )
        if resolved is None or not _is_there(path):
            raise SettingsError(f"Option '{option}': {path} does not exist on the server; {remedy}.")

    def redact(self, sentence: str, located: JobSpec) -> str:
        """Return a sentence about a job without the server's folders, if some of its readers may not name them."""
        return sentence if self._roots is None else redact_folders(sentence, located, self._data)

    def _is_allowed(self, path: Path) -> bool:
        return not path.is_relative_to(self._data) and any(path.is_relative_to(root) for root in self._roots or ())


def without_folders(spec: JobSpec) -> JobSpec:
    """Return a job's options with only the last part of every path to a folder of the server, for viewers who may not
    use those folders.
    """
    changes: dict[str, object] = {
        name: Path(path.name)
        for name in ("capture", "calibration")
        if (path := getattr(spec, name)) and path.is_absolute()
    }
    if spec.rig is not None and spec.rig.mouth.is_absolute():
        changes["rig"] = spec.rig.model_copy(update={"mouth": Path(spec.rig.mouth.name)})
    return spec.model_copy(update=changes) if changes else spec


def redact_folders(text: str, located: JobSpec, data: Path) -> str:
    """Remove the server's folders, in which the files of a job lie, from a sentence about the job: not everybody who
    reads it may name them.

    Args:
        located: the job's options with the paths of the files that the server stores.
        data: the server's own folder. The paths below it, ``captures/ID`` and ``jobs/ID``, are known to everybody and
            stay.
    """
    named = (located.capture, located.calibration, located.rig.mouth if located.rig is not None else None)
    folders = [
        path.parent for path in named if path is not None and path.is_absolute() and not path.is_relative_to(data)
    ]
    for folder in sorted({data, *folders}, key=lambda one: len(str(one)), reverse=True):
        if folder != folder.parent:
            text = text.replace(f"{folder}/", "")
    return text


def _resolved(path: Path) -> Path | None:
    # Follow all links; None for a path that cannot exist, such as a loop of links.
    try:
        str(path).encode()  # a path that is not valid Unicode could not be stored
        return path.resolve()
    except (OSError, ValueError, RuntimeError):
        return None


def _is_there(path: Path) -> bool:
    try:
        path.stat()
    except (OSError, ValueError):
        return False
    return True
