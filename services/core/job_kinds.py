"""The kinds of job: the stages of each, the functions that run them, and the options that it alone has.

A kind is one entry of ``JOB_KINDS`` and the module that its doors name; its options are fields of ``JobSpec``. An
installed package adds a kind by an entry point of the group ``dentine.job_kinds`` that leads to a ``JobKind``. Every
process reads the entry points for itself, so a worker knows an added kind only where its package is installed;
elsewhere its error lists the kinds that it knows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any

from services.core.stage import StageName

COMMON_OPTIONS = frozenset({"kind", "capture", "seed", "workers", "priority"})
"""Options that every kind of job has."""


@dataclass(frozen=True)
class JobKind:
    """One kind of job."""

    summary: str
    """What a job of this kind measures, in a few words."""
    stages: tuple[StageName, ...]
    """Stages in their order, without those that make a capture."""
    doors: Mapping[StageName, str]
    """Stage -> ``module:function`` that runs it; only workers import it."""
    own_options: frozenset[str] | None
    """Options besides the common ones; None for all options that no other kind lists as its own."""
    fixed_options: Mapping[str, Any] = field(default_factory=dict)
    """Options that have only one possible value in this kind's fit, with that value."""
    lacking_options: frozenset[str] = frozenset()
    """Options that other kinds share and this one does not have."""

    @property
    def has_rig(self) -> bool:
        """Whether a job of this kind may begin with a capture."""
        return "capture" in self.doors


_TEETH: Mapping[StageName, str] = {
    "phantom": "services.phantom.stage:run",
    "capture": "services.capture.stage:run",
    "register": "services.calibrate.stage:run",
    "prepare": "services.preprocess.stage:run",
    "fit": "services.fit.stage:run",
    "export": "services.assets.stage:export",
}
_SLAB: Mapping[StageName, str] = {"fit": "services.slab.stage:run", "export": "services.slab.stage:export"}

SLAB_OPTIONS = frozenset({"effort", "dictionary", "particle_index", "particle_absorption"})
"""Options that only a slab has."""
OPTIONS_OF_TEETH = frozenset({"fdi", "surroundings", "dentin", "prior", "stains", "rig"})
"""Options that presume teeth, or a mouth before a dome."""
_OF_A_JAW: Mapping[str, Any] = {
    "fdi": None,
    "surroundings": "auto",
    "lobes": 1,
    "held": {},
    "stains": False,
    "solver": "gauss-newton",
    "loss": "l2",
}

ENTRY_POINTS = "dentine.job_kinds"
"""Name of the group of entry points by which installed packages add kinds."""
JOB_KINDS: Mapping[str, JobKind] = MappingProxyType(
    {
        "tooth": JobKind("one tooth", ("prepare", "fit", "export"), _TEETH, None),
        "jaw": JobKind(
            "all teeth with gums and the wall of the mouth", ("prepare", "fit", "export"), _TEETH, None, _OF_A_JAW
        ),
        "object": JobKind(
            "any closed object, homogeneous or with a known core",
            ("prepare", "fit", "export"),
            {
                "prepare": "services.preprocess.stage:run_object",
                "fit": "services.fit.stage:run",
                "export": "services.assets.stage:export",
            },
            None,
            lacking_options=OPTIONS_OF_TEETH,
        ),
        "slab": JobKind("a material in a cell", ("fit", "export"), _SLAB, SLAB_OPTIONS),
        "calibration": JobKind(
            "a rig's cameras, lights and colours, by boards, spheres and a chart",
            ("export",),
            {"export": "services.calibrate.stage:calibrate"},
            frozenset(),
        ),
    }
)
"""The kinds of this package."""


@cache
def job_kinds() -> Mapping[str, JobKind]:
    """All kinds that this process knows: those of this package, which no other can replace, and those of others."""
    added = {point.name: point.load() for point in entry_points(group=ENTRY_POINTS) if point.name not in JOB_KINDS}
    return MappingProxyType({**JOB_KINDS, **added})


def known_kind(name: str) -> str:
    """Return the name of a kind unchanged, if there is such a kind.

    Raises:
        ValueError: there is no such kind; the message lists the known ones.
    """
    if name not in job_kinds():
        raise ValueError(f"there is no kind of job '{name}'; the kinds are {', '.join(job_kinds())}")
    return name


def foreign_options(kind: str, options: frozenset[str]) -> frozenset[str]:
    """Return those of the given options that jobs of this kind do not have."""
    own = job_kinds()[kind].own_options
    others = frozenset().union(*(other.own_options or () for name, other in job_kinds().items() if name != kind))
    return options - COMMON_OPTIONS - own if own is not None else options & (others | job_kinds()[kind].lacking_options)
