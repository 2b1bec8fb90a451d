"""The dictionaries from which a slab's fit builds a phase function. Each is one entry of ``DICTIONARIES``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from services.core.choices import chosen
from services.core.errors import SettingsError


@dataclass(frozen=True)
class SlabDictionary:
    """One dictionary."""

    summary: str
    """Its phase functions, in a few words."""
    door: str
    """``module:function`` that builds it for one wavelength; only the process of the fit imports it."""


DEFAULT_DICTIONARY = "tents"
DICTIONARIES: Mapping[str, SlabDictionary] = MappingProxyType(
    {
        "tents": SlabDictionary("any smooth phase function", "services.slab.dictionaries.tents:tents"),
        "hg": SlabDictionary("a mix of Henyey-Greenstein lobes", "services.slab.dictionaries.hg:lobes"),
        "mie": SlabDictionary("spheres of many sizes", "services.slab.dictionaries.mie:spheres"),
        "table": SlabDictionary(
            "phase functions of your own, from dictionary.csv or dictionary.npy in the folder",
            "services.slab.dictionaries.table:table",
        ),
    }
)


def known_dictionary(name: str) -> str:
    """Return the name of a dictionary unchanged, if there is such a dictionary.

    Raises:
        ValueError: there is no such dictionary; the message lists the known ones.
    """
    try:
        chosen("dictionary", name, DICTIONARIES)
    except SettingsError as problem:
        raise ValueError(str(problem).rstrip(".")) from problem
    return name


def require_particles(dictionary: str, particle_index: float | None, particle_absorption: float) -> None:
    """Check that the particles' index is given for the dictionary that needs it, and for no other.

    Raises:
        ValueError: it is missing, or the chosen dictionary does not use it.
    """
    if dictionary == "mie" and particle_index is None:
        raise ValueError("dictionary = mie needs particle_index, such as 1.598 for polystyrene at 532 nm")
    if dictionary != "mie" and (particle_index is not None or particle_absorption):
        name = "particle_absorption" if particle_index is None else "particle_index"
        raise ValueError(f"{name} is an option of dictionary = mie; leave it out, or choose mie")
