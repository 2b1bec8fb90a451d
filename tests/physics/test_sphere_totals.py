"""Totals by discrete ordinates compared to adding-doubling, and the readings of an integrating sphere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.core.slab.folder import Cell, Glass
from services.slab.cell.interface import Interface
from services.slab.sphere.invert import interface_of
from services.slab.sphere.records import Sphere, SphereFile, TotalsReading
from services.slab.sphere.spectrometer import expected
from services.transport.optics.slab_totals import Optics, Totals, slab_totals
from tests.support.slab_tables import total_cases

GLASS = Cell(width_mm=1, index=1.34, glass=Glass(index=1.5, thickness_mm=1))
SPHERE = Sphere(diameter_mm=203.2, sample_port_mm=25.4, third_port_mm=12.7, detector_port_mm=1, wall_reflectance=0.96)
FIRST_BOUNCE = 1 - 0.000978
"""Share of the sphere's wall without the entrance port. IAD 3.16 counts the first bounce behind the baffle (this
share times the wall's reflectance) for the sample but not for the standard, so its figures are compared to ours
times both."""

TABLE = [
    (0.9, 0.75, 2.0, 1.0, (0.09739464, 0.66095770, 0.19109023, 0.50181606)),
    (1.0, 0.0, 1.0, 1.0, (0.34132876, 0.65867124, 0.44659401, 0.55340599)),
    (0.99, 0.9, 10.0, 1.0, (0.24762765, 0.58908151, 0.37571223, 0.45085542)),
    (0.99999, 0.0, 1000.0, 1.0, (0.99085450, 7.629854e-05, 0.99272510, 6.059598e-05)),
    (0.9, 0.0, math.inf, 1.5, (0.25991858, 0.0, 0.30789002, 0.0)),
    (0.5, 0.9, 1.0, 1.4, (0.03895326, 0.54506757, 0.09199007, 0.43747217)),
    (0.99, 0.8, 5.0, 1.631, (0.32853474, 0.46492220, 0.38193355, 0.41305722)),
]
"""Albedo, g, optical thickness, index, and (R, T) for a beam and for diffuse light by adding-doubling with 256 to 512
nodes. The first row is also in van de Hulst's tables, the fifth in Giovanelli's."""


def four(totals: Totals) -> tuple[float, float, float, float]:
    return totals.reflectance, totals.transmittance, totals.reflectance_diffuse, totals.transmittance_diffuse


@pytest.mark.parametrize(("albedo", "g", "depth", "index", "values"), TABLE)
def test_totals_agree_with_adding_doubling(
    albedo: float, g: float, depth: float, index: float, values: tuple[float, float, float, float]
) -> None:
    totals = slab_totals(Optics(1 - albedo, albedo, g), depth, Interface(index))
    # With 32 nodes the error is 4e-5 for g = 0.9 behind a refracting face, and smaller for the other rows.
    assert four(totals) == pytest.approx(values, abs=5e-5)


def test_totals_converge() -> None:
    # The table's own error is 6e-8, and that of its printed digits 5e-9.
    for albedo, g, depth, index, values in TABLE:
        assert four(slab_totals(Optics(1 - albedo, albedo, g), depth, Interface(index), nodes=96)) == pytest.approx(
            values, abs=1e-7
        )


def test_totals_agree_with_the_whole_table() -> None:
    for case in total_cases():
        (layer,) = case.layers
        interface = Interface(case.ior if case.boundary == "smooth" else 1.0)
        assert layer.sigma == 1
        totals = four(slab_totals(Optics(1 - layer.alpha, layer.alpha, layer.g1), layer.thickness_mm, interface))
        told = totals[:2] if case.source == "normal" else totals[2:]
        # 32 nodes do not resolve the peak of |g| = 0.99.
        assert told == pytest.approx(case.values[0], abs=2e-4 if abs(layer.g1) > 0.95 else 5e-5), case.name


def test_a_slab_between_glass_slides_reads_as_measured() -> None:
    # The values 0.16208 and 0.26446 are for sample A of iadpython's examples at 810 nm, converged with 64 points.
    totals = slab_totals(Optics(0.4445, 1.206, 0), 1, interface_of(GLASS))
    assert totals.reflectance == pytest.approx(0.16208, abs=1e-5)
    assert totals.transmittance == pytest.approx(0.26446, abs=1e-5)
    # These are the readings, which were inverted with 8 points.
    assert totals.reflectance == pytest.approx(0.16271, abs=7e-4)
    assert totals.transmittance == pytest.approx(0.26479, abs=4e-4)


@pytest.mark.parametrize("g", [0.0, 0.9])
def test_white_slabs_return_all_light_and_grey_ones_less(g: float) -> None:
    white = slab_totals(Optics(0, 10, g), 1, interface_of(GLASS))
    assert white.reflectance + white.transmittance == pytest.approx(1, abs=1e-7)
    assert white.reflectance_diffuse + white.transmittance_diffuse == pytest.approx(1, abs=1e-7)
    grey = slab_totals(Optics(0.1, 10, g), 1, interface_of(GLASS))
    assert grey.reflectance + grey.transmittance < 0.95


def test_unscattered_light_is_what_is_left_without_scattering() -> None:
    clear = slab_totals(Optics(0.7, 0, 0), 2, interface_of(GLASS))
    assert clear.transmittance == pytest.approx(clear.transmittance_unscattered, abs=1e-9)
    assert clear.reflectance == pytest.approx(clear.reflectance_unscattered, abs=1e-9)
    # By hand, without multiple reflections: light passes both slides once.
    passes = interface_of(GLASS).transmittance(0)
    assert clear.transmittance == pytest.approx(passes**2 * math.exp(-1.4), rel=2e-3)


def test_slanted_beams_make_up_diffuse_light() -> None:
    """Diffuse light is made of beams: the mean of their totals over 2 cos d(cos) is its own."""
    optics, interface = Optics(0.1, 2, 0.7), interface_of(GLASS)
    places, shares = np.polynomial.legendre.leggauss(12)
    cosines = (places + 1) / 2
    slanted = [slab_totals(optics, 1, interface, incidence_deg=math.degrees(math.acos(cosine))) for cosine in cosines]
    mean = [
        float(np.sum(shares * cosines * [getattr(totals, name) for totals in slanted]))
        for name in ("reflectance", "transmittance")
    ]
    # Fresnel's laws at grazing incidence leave 12 nodes an error of 1e-4.
    assert mean == pytest.approx([slanted[0].reflectance_diffuse, slanted[0].transmittance_diffuse], abs=3e-4)


def test_a_slanted_beam_has_a_longer_path() -> None:
    clear = slab_totals(Optics(0.7, 0, 0), 2, interface_of(GLASS), incidence_deg=60)
    sine = math.sin(math.radians(60)) / 1.34
    passes = interface_of(GLASS).transmittance(sine)
    assert clear.transmittance == pytest.approx(clear.transmittance_unscattered, abs=1e-9)
    # By hand, without multiple reflections.
    assert clear.transmittance == pytest.approx(passes**2 * math.exp(-1.4 / math.sqrt(1 - sine**2)), rel=2e-3)


def file_of(sphere: Sphere | None, **changes: object) -> SphereFile:
    told: dict[str, object] = {
        "kind": "sphere", "units": "mm", "cell": GLASS, "totals": [{"R": 0.5, "T": 0.3}],
        "reflection_sphere": sphere, "transmission_sphere": sphere,
    }  # fmt: skip
    return SphereFile.model_validate(told | changes)


def reflection(totals: Totals, file: SphereFile) -> float:
    return expected(totals, file, file.totals[0]).R


def test_a_sample_that_is_the_standard_reads_as_the_standard() -> None:
    totals = Totals(0.7, 0.1, 0.0, 0.0, 0.7, 0.1)
    file = file_of(SPHERE, standard_reflectance=0.7)
    assert reflection(totals, file) == pytest.approx(0.7, rel=1e-12)
    # With a sample darker than the standard, less light circulates in the sphere, so the sample reads too dark.
    darker = Totals(0.3, 0.1, 0.0, 0.0, 0.3, 0.1)
    assert reflection(darker, file) < 0.3


def test_a_sphere_without_wall_has_no_gain() -> None:
    black = SPHERE.model_copy(update={"wall_reflectance": 0.0, "third_port_mm": 0.0})
    totals = Totals(0.3, 0.2, 0.0, 0.0, 0.3, 0.2)
    file = file_of(black)
    assert reflection(totals, file) == pytest.approx(0.3, rel=1e-12)


@pytest.mark.parametrize(
    ("absorption", "reduced", "standard", "walls", "read"),
    [
        (0.4056, 1.4329, 0.96, (0.96, 0.96), (0.16830, 0.24974)),
        (0.1050, 1.4528, 0.96, (0.96, 0.96), (0.28689, 0.42759)),
        (0.0259, 2.6249, 0.96, (0.97, 0.991), (0.47248, 0.47882)),
    ],
)
def test_readings_of_one_sphere_agree_with_iad(
    absorption: float, reduced: float, standard: float, walls: tuple[float, float], read: tuple[float, float]
) -> None:
    """Samples C (800, 1000 nm) and D (925 nm) of iadpython's examples with the coefficients that IAD 3.16 gives."""
    told = {"R": read[0], "T": read[1], "reflection_wall": walls[0], "transmission_wall": walls[1]}
    file = file_of(SPHERE, standard_reflectance=standard, totals=[told])
    totals = slab_totals(Optics(absorption, reduced, 0), 1, interface_of(GLASS))
    reflected, through = reflection(totals, file), expected(totals, file, file.totals[0]).T
    # IAD inverts with 8 points, which changes R by 6e-4 and T by 4e-4 (see above).
    assert reflected * FIRST_BOUNCE * walls[0] == pytest.approx(read[0], abs=7e-4)
    assert through == pytest.approx(read[1], abs=7e-4)


def test_what_a_sphere_lets_out_is_not_read() -> None:
    totals = slab_totals(Optics(0.1, 1, 0), 1, interface_of(GLASS))
    whole, less = file_of(None), file_of(None, specular_included=False, unscattered_included=False)
    reading: TotalsReading = whole.totals[0]
    both = expected(totals, whole, reading), expected(totals, less, reading)
    mirror, through = both[0].R - both[1].R, both[0].T - both[1].T
    assert mirror == pytest.approx(totals.reflectance_unscattered, rel=1e-9)
    assert through == pytest.approx(totals.transmittance_unscattered, rel=1e-9)
