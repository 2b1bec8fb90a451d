"""The sample for which a dictionary is made, and the dictionary that a fit uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.choices import chosen
from services.core.slab.dictionaries import DICTIONARIES
from services.core.slab.folder import SlabFolder
from services.slab.dictionaries.through_beam import index_of
from services.slab.options import SlabOptions
from services.slab.solve.coordinates import Coordinates

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """The sample in a folder at one wavelength."""

    root: Path
    wavelength_nm: float
    index: float
    """Index of refraction of the medium that surrounds the particles."""
    options: SlabOptions


@dataclass(frozen=True)
class Spheres:
    """Sizes of atoms that are spheres (M,)."""

    radii_um: Array
    volume_mm: Array
    """Share of the sample's volume that gives a scattering coefficient of 1 per mm."""


@dataclass(frozen=True)
class ChosenDictionary:
    """A dictionary for one wavelength."""

    coordinates: Coordinates
    names: tuple[str, ...] = ()
    """Names of the atoms whose weights are the unknowns; empty where the unknowns are the phase function itself."""
    spheres: Spheres | None = None


DictionaryFactory = Callable[[Sample], ChosenDictionary]


def dictionary_of(root: Path, folder: SlabFolder, wavelength_nm: float, options: SlabOptions) -> ChosenDictionary:
    """The dictionary that the options name.

    Raises:
        SettingsError: there is no such dictionary, or an option of it is wrong.
        CaptureInputError: the dictionary's file is wrong.
    """
    module, _, function = chosen("dictionary", options.dictionary, DICTIONARIES).door.partition(":")
    factory: DictionaryFactory = getattr(import_module(module), function)
    return factory(Sample(root, wavelength_nm, index_of(folder, wavelength_nm).value, options))
