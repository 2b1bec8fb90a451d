"""Checks of folders that a user names, before anything is written into them."""

from __future__ import annotations

import os
from pathlib import Path

from services.core.errors import InputError


def require_folder(path: Path, option: str) -> None:
    """Refuse a path that is no folder for results: neither a writable folder, nor one that can be made.

    Raises:
        InputError: the path is a file, lies below a file, or may not be written to.
    """
    try:
        nearest = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
    except OSError as problem:
        raise InputError(f"{option} {path} cannot be a folder ({problem.strerror}); name another one.") from problem
    if not nearest.is_dir():
        raise InputError(f"{option} {path} cannot be a folder, as {nearest} is a file; name another one.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(
            f"{option} {path} cannot be written, as {nearest} takes no new file; correct its permissions or name"
            " another one."
        )


def require_outside(path: Path, source: Path | None, option: str) -> None:
    """Refuse to write results into the folder that they are made from.

    Raises:
        InputError: the folder is the source or lies in it.
    """
    if source is not None and path.resolve().is_relative_to(source.resolve()):
        raise InputError(
            f"{option} {path} lies in {source}, which the results are made from; name a folder outside of it."
        )
