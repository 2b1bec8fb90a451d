"""Import of packages that an extra of this distribution brings; a failure is an error of one sentence."""

from __future__ import annotations

import importlib
from collections.abc import Iterable

from services.core.errors import PlatformError


def require_packages(names: Iterable[str], extra: str) -> None:
    """Import packages.

    Raises:
        PlatformError: a package is not installed, or cannot be loaded, for example because it lacks a system library.
    """
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as problem:
            what = f"The package {problem.name} is not installed; install dentine[{extra}] on this machine."
            raise PlatformError(what) from problem
        except Exception as problem:
            first = str(problem).splitlines()[0] if str(problem) else ""
            what = f"The package {name} is installed but cannot be loaded ({type(problem).__name__}: {first})"
            raise PlatformError(f"{what}; install the system's libraries that it needs.") from problem
