"""Which folders of the server and which S3 stores a job may name.

Folders are those below the roots that the settings allow, and none where callers need tokens and no root is set. Stores
are those that the settings name and what lies below them, on every server: whoever submits a job else chose where the
server's own credentials write.
"""

from __future__ import annotations

import re
from pathlib import Path

from services.core.errors import SettingsError
from services.core.files.object_store import require_library
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.store_url import STORE_URL

SETTING = "DENTINE__SERVER__JOB_ROOTS"
STORES_SETTING = "DENTINE__SERVER__STORES"


class ServerStores:
    """The S3 stores that a server's jobs may name.

    Raises:
        SettingsError: a setting is no such URL. PlatformError: there is one, and what speaks to S3
            servers is not installed.
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
            SettingsError: it is not.
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
        roots: folders below which they lie; None allows any path.
        data: the server's own folder, in which nothing may be named: it holds what belongs to others.

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
        """Those that the settings allow."""
        named = tuple(Path(one.strip()) for one in settings.job_roots.split(",") if one.strip())
        return cls(None if settings.access == "open" and not named else named, settings.data)

    def require(self, option: str, path: Path, remedy: str = "check the path") -> None:
        """Refuse a path that means nothing on the server, or may not be named; ``remedy`` says what to do about one
        that is absent.

        What may not be named is refused in the same words whether it is there or not.

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

    def tell(self, sentence: str, located: JobSpec) -> str:
        """Why a job failed, without the server's folders where some of those who read it may not name them."""
        return sentence if self._roots is None else told_without_folders(sentence, located, self._data)

    def _is_allowed(self, path: Path) -> bool:
        return not path.is_relative_to(self._data) and any(path.is_relative_to(root) for root in self._roots or ())


def without_folders(spec: JobSpec) -> JobSpec:
    """A job's options with the names alone of what lies in folders of the server, for whoever may not use those."""
    changes: dict[str, object] = {
        name: Path(path.name)
        for name in ("capture", "calibration")
        if (path := getattr(spec, name)) and path.is_absolute()
    }
    if spec.rig is not None and spec.rig.mouth.is_absolute():
        changes["rig"] = spec.rig.model_copy(update={"mouth": Path(spec.rig.mouth.name)})
    return spec.model_copy(update=changes) if changes else spec


def told_without_folders(text: str, located: JobSpec, data: Path) -> str:
    """A sentence about a job without the folders on the server that its files lie in: those who read it need not be
    those who may name them.

    Args:
        located: the job's options with the files of what the server stores.
        data: the server's own folder, in which ``captures/ID`` and ``jobs/ID`` are as everybody calls them.
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
    # With all links followed; None for what cannot be a path, such as a loop of links.
    try:
        str(path).encode()  # what has no name in Unicode could not be stored
        return path.resolve()
    except (OSError, ValueError, RuntimeError):
        return None


def _is_there(path: Path) -> bool:
    try:
        path.stat()
    except (OSError, ValueError):
        return False
    return True
