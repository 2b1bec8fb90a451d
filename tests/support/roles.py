"""The roles of the service: the extras that each is installed with, and the modules where it enters the code."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOME_AT_THE_SERVER = "services.capture.console"
_NAME_AND_EXTRAS = re.compile(r"\s*([A-Za-z0-9._-]+)\s*(?:\[([^\]]*)\])?")
_EXTRA_MARKER = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


@dataclass(frozen=True)
class Role:
    """One part of the service.

    Attributes:
        extras: extras of the package that its machine or its image installs.
        entries: ``module`` or ``module:function`` where it enters the code, including names that stand in strings.
    """

    extras: tuple[str, ...]
    entries: tuple[str, ...]


_COMMANDS = ("services.cli.app:build_app",)
_WORKER: tuple[str, ...] = (
    *_COMMANDS,
    "services.cli.dask",
    "services.pipeline.stages",
    "services.cli.raw.board",
    "services.cli.raw.calibrate",
    "services.cli.raw.register",
    "services.preprocess.stage",
    "services.fit.stage",
    "services.tasks.engine_host",
)
_WORKER += ("services.transport.engine", "services.pipeline.worker_setup", "services.pipeline.worker_check")

ROLES: Mapping[str, Role] = {
    "api": Role(("api", "capture"), (*_COMMANDS, "services.cli.serve", "services.cli.token", DOME_AT_THE_SERVER)),
    "scheduler": Role((), (*_COMMANDS, "services.cli.dask")),
    "worker": Role(("worker",), _WORKER),
    "rig": Role(("worker", "capture"), (*_WORKER, "services.capture.stage")),
    "dome": Role(("capture",), (*_COMMANDS, "services.cli.dome_sim", "services.capture.dome.simulator")),
    "client": Role(
        (),
        (
            *_COMMANDS,
            "services.cli.client.submit",
            "services.cli.client.jobs",
            "services.cli.client.delete",
            "services.cli.client.download",
        ),
    ),
}


def distributions(extras: Iterable[str]) -> set[str]:
    """Normalised names of all distributions that ``pip install dentine[extras]`` installs: the requirements of this
    tree and, as installed here, theirs.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional: dict[str, list[str]] = project["optional-dependencies"]
    found: set[tuple[str, str]] = set()
    todo = [*project["dependencies"], *(f"dentine[{extra}]" for extra in extras)]
    while todo:
        name, wanted = _parse(todo.pop())
        if name == "dentine":
            todo += [one for extra in wanted for one in optional[extra]]
            continue
        for extra in ("", *wanted):
            if (name, extra) not in found:
                found.add((name, extra))
                todo += _requirements(name, extra)
    return {name for name, _ in found}


def normal(name: str) -> str:
    """A distribution's normalised name, as package indexes compare names (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _parse(requirement: str) -> tuple[str, tuple[str, ...]]:
    match = _NAME_AND_EXTRAS.match(requirement)
    assert match is not None, requirement
    return normal(match[1]), tuple(one.strip() for one in (match[2] or "").split(",") if one.strip())


@cache
def _requirements(name: str, extra: str) -> tuple[str, ...]:
    return tuple(_required_by(name, extra))


def _required_by(name: str, extra: str) -> Iterator[str]:
    try:
        requirements = importlib.metadata.requires(name) or ()
    except importlib.metadata.PackageNotFoundError:
        return  # a requirement of another Python version or another system
    for requirement in requirements:
        marker = _EXTRA_MARKER.search(requirement)
        if (marker[1] if marker else "") == extra:
            yield requirement.partition(";")[0]
