"""Readings of an integrating sphere for a slab whose totals are known: theory of Pickering et al. (Appl. Opt. 32, 399,
1993) with baffles.

Light in a sphere goes to and fro until the detector, an open port or the sample absorbs it; its gain depends on the
sample, which lies in the wall. Substituting the standard for the sample changes that gain, and the reading is off by
the ratio.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from services.slab.sphere.records import Sphere, SphereFile, TotalsReading
from services.transport.optics.slab_totals import Totals


@dataclass(frozen=True)
class Readings:
    """Readings of the instrument."""

    R: float
    T: float
    T_unscattered: float


def expected(totals: Totals, file: SphereFile, reading: TotalsReading) -> Readings:
    """The readings that the instrument gives for a slab.

    Args:
        totals: of the slab.
        file: the instrument, with what the reading has of its own (``SphereFile.of``).
        reading: which readings are meant.
    """
    diffuse = reading.source == "diffuse"
    r = totals.reflectance_diffuse if diffuse else totals.reflectance
    t = totals.transmittance_diffuse if diffuse else totals.transmittance
    alone_r, alone_t = (0.0, 0.0) if diffuse else (totals.reflectance_unscattered, totals.transmittance_unscattered)
    mirror = alone_r * _share(reading.specular_share, file.specular_included)
    through = _share(reading.unscattered_share, file.unscattered_included)
    return Readings(
        R=_reflection(file, reading, r - alone_r, mirror, totals.reflectance_diffuse),
        T=_transmission(file, reading, t - alone_t, alone_t, through, totals.reflectance_diffuse),
        T_unscattered=totals.transmittance_unscattered,
    )


def _reflection(file: SphereFile, reading: TotalsReading, scattered: float, mirror: float, sample: float) -> float:
    """Reflectance reading relative to the standard. The beam meets sample and standard first; the third port is the
    open entrance.
    """
    if (sphere := _with_wall(file.reflection_sphere, reading.reflection_wall)) is None:
        return scattered + mirror
    # Behind a baffle light meets the wall first. The wall receives all of the mirror's light, but scattered light less
    # the entrance's share.
    wall_share = 1 - _area(sphere, sphere.third_port_mm) if sphere.baffle else 1.0
    return (scattered + mirror / wall_share) * _gain(sphere, sample) / _gain(sphere, file.standard_reflectance)


def _transmission(
    file: SphereFile, reading: TotalsReading, scattered: float, alone: float, share: float, sample: float
) -> float:
    """Transmittance reading relative to the beam with no sample. The third port, where the beam ends, holds a white
    cap, or is no port (0 mm): then the beam ends at the wall, as IAD takes it.
    """
    if (sphere := _with_wall(file.transmission_sphere, reading.transmission_wall)) is None:
        return scattered + share * alone
    standard = file.transmission_standard if sphere.third_port_mm else sphere.wall_reflectance
    cap = standard if share > 0 or not sphere.third_port_mm else 0.0
    third = _area(sphere, sphere.third_port_mm)
    first = sphere.wall_reflectance * (1 - third) + third * cap if sphere.baffle else 1.0
    return (first * scattered + cap * share * alone) * _gain(sphere, sample, cap) / _gain(sphere, 0.0, standard)


def _share(own: float | None, is_included: bool) -> float:
    return float(is_included) if own is None else own


def _gain(sphere: Sphere, sample: float, third: float = 0.0) -> float:
    """Mean number of times that light meets the detector, relative to a sphere of black walls.

    Args:
        sample: reflectance of the sample for diffuse light.
        third: reflectance of the cap in the third port, 0 for an open port.
    """
    sample_area, third_area, detector_area = (
        _area(sphere, port) for port in (sphere.sample_port_mm, sphere.third_port_mm, sphere.detector_port_mm)
    )
    wall_area = 1 - sample_area - third_area - detector_area
    ports = detector_area * sphere.detector_reflectance + sample_area * sample
    if not sphere.baffle:
        return 1 / (1 - wall_area * sphere.wall_reflectance - ports - third_area * third)
    wall = sphere.wall_reflectance + third_area / wall_area * third
    return 1 / (1 - wall * (wall_area + (1 - third_area) * ports))


def _area(sphere: Sphere, port_mm: float) -> float:
    """A port's share of the sphere's surface."""
    return (1 - math.sqrt(1 - (port_mm / sphere.diameter_mm) ** 2)) / 2


def _with_wall(sphere: Sphere | None, wall: float | None) -> Sphere | None:
    """The sphere with its wall at this wavelength."""
    return sphere if sphere is None or wall is None else sphere.model_copy(update={"wall_reflectance": wall})
