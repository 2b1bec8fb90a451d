"""Faults that are reported in a cell's images before a fit: each with its number and remedy; good images give none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.core.slab.folder import Beam, Light, PixelGrid, SlabCamera, SlabFolder
from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.slab.dictionaries.chosen import ChosenDictionary
from services.slab.fit import fit_images
from services.slab.options import SlabOptions
from services.slab.read.diagnosis import (
    grid_faults,
    image_faults,
    max_power_per_sr,
    sample_faults,
    similarity_faults,
    standing_out,
)
from services.slab.read.images import Measurements, shot_noise
from services.slab.solve.coordinates import Knots
from tests.support.small_slab import description, small_rig

PIXELS = PixelGrid(x_mm=(-4.0, 4.0), y_mm=(-4.0, 4.0), columns=16, rows=16)
BEAM = Beam(profile="gaussian", sigma_mm=0.25)


def spot(y_mm: float = 0.0, noise: float = 0.0) -> NDArray[np.float64]:
    """A blurred beam."""
    at = -4.0 + 0.5 * (np.arange(16) + 0.5)
    image = np.exp(-np.abs(at[:, None] - y_mm) - np.abs(at[None, :]))
    return np.asarray(image * (1 + noise * np.random.default_rng(1).normal(size=image.shape)))


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_a_good_image_says_nothing(noise: float) -> None:
    assert image_faults("b0 under l0", spot(noise=noise), PIXELS, BEAM) == ()
    assert grid_faults(PIXELS) == ()


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        (
            np.minimum(spot(noise=0.01), 0.3),
            "Image b0 under l0 looks saturated: 12 pixels hold its largest value, 0.3; ",
        ),
        (spot(y_mm=1.5), "In image b0 under l0 the light lies 1.5 mm off the plane y = 0; "),
        (np.zeros((16, 16)), "Image b0 under l0 holds no light; "),
        (np.full((16, 16), np.nan), "Image b0 under l0 holds no light; "),
    ],
)
def test_a_faulty_image_is_told_with_its_number_and_remedy(image: NDArray[np.float64], sentence: str) -> None:
    (told,) = image_faults("b0 under l0", image, PIXELS, BEAM)
    assert told.startswith(sentence)


def test_no_cell_is_proposed_that_nobody_sells() -> None:
    clear, dense = (henyey_greenstein(sigma, 0.5, 0.0) for sigma in (0.01, 1e6))
    assert sample_faults(clear, 1.0)[0].endswith("concentrate it 2e+02-fold.")
    assert sample_faults(dense, 1.0)[0].endswith("dilute it 5e+05-fold.")


def test_pixels_that_lie_beside_the_beam_are_told() -> None:
    (told,) = grid_faults(PIXELS.model_copy(update={"x_mm": (1.0, 9.0)}))
    assert told == "The beam meets the cell at x = 0, beside the pixels; correct pixels.x_mm."


@pytest.mark.parametrize(
    ("sigma_s", "sigma_a", "sentences"),
    [
        (1.0, 0.05, ()),
        (0.04, 0.001, ("The sample is too thin: σt·w is about 0.041",)),
        (
            20.0,
            0.0,
            (
                (
                    "The sample is too thick: σt·w is about 20, and images tell a phase function from 0.1 to 10; dilute"
                    " it 10-fold"
                ),
            ),
        ),
        (0.1, 0.9, ("The sample absorbs too much: about 90 % ",)),
    ],
)
def test_a_sample_that_tells_nothing_is_told_with_what_to_measure(
    sigma_s: float, sigma_a: float, sentences: tuple[str, ...]
) -> None:
    found = sample_faults(henyey_greenstein(sigma_s, 0.5, sigma_a), width_mm=1.0)
    assert len(found) == len(sentences)
    assert all(told.startswith(sentence) for told, sentence in zip(found, sentences, strict=True))


def test_a_thick_sample_of_which_only_the_reduced_scattering_is_fixed_is_told_how_to_dilute_it() -> None:
    thick, thin = henyey_greenstein(9.0, 0.45, 0.0), henyey_greenstein(1.0, 0.45, 0.0)
    (told,) = similarity_faults(thick, 1.0, scattering=False, reduced=True)
    assert told.startswith("The images fix σs′, but not σs and g by themselves: at a σt·w of 9 ")
    assert told.endswith("dilute it 4.5-fold, or take a cell of 0.22 mm.")
    assert similarity_faults(thick, 1.0, scattering=True, reduced=True) == ()
    assert similarity_faults(thick, 1.0, scattering=False, reduced=False) == ()
    assert similarity_faults(thin, 1.0, scattering=False, reduced=True) == ()


@pytest.mark.slow
def test_a_fit_of_an_absorbing_sample_says_so_and_not_that_it_is_thin() -> None:
    # The medium that a fit starts from has a sigma_t w of 0.05 here.
    rig, rng = small_rig(), np.random.default_rng(1)
    exact = render(rig, henyey_greenstein(0.15, 0.5, 1.5), seed=9, step=0, batches=1, paths=100_000, scores=False).mean
    variances = np.stack([shot_noise(image) for image in exact])
    images = exact + np.sqrt(variances) * rng.normal(size=exact.shape)
    measured = Measurements(images, variances, np.zeros(len(images), dtype=bool), (("", ""),) * len(images), True)
    folder, options = SlabFolder.model_validate(description()), SlabOptions(effort=0.1)
    notes = fit_images(folder, 532.0, measured, options, map, ChosenDictionary(Knots())).fit.notes
    assert sum(note.startswith("The sample absorbs too much: ") for note in notes) == 1
    assert not any(note.startswith("The sample is too") for note in notes)


def test_no_image_beside_the_beam_may_show_more_than_a_cone_of_all_light() -> None:
    light = Light(name="l0", side="front", angle_deg=10.0)

    def most(angle_deg: float) -> float:
        return max_power_per_sr(SlabCamera(name="b0", side="back", angle_deg=angle_deg), light)

    assert most(14.0) == np.inf
    # A cone of 20 degrees has 0.379 sr, one of 60 degrees pi.
    assert most(30.0) == pytest.approx(2.5 / 0.379, rel=1e-3)
    assert most(-50.0) == 1.0


PLACES = [(camera, light) for camera in ("f0", "f1", "b0") for light in ("l0", "l1")]


@pytest.mark.parametrize(
    ("errors", "sentence"),
    [
        (
            (0.2, 0.05, 0.38, 0.51, 0.1, 0.22),
            "The images of camera f1 are 38 to 51 % off the fit, and all",
        ),
        (
            (0.1, 0.4, 0.12, 0.5, 0.1, 0.6),
            "The images of light l1 are 40 to 60 % off the fit, and all",
        ),
        ((0.2, 0.05, 0.3, 0.51, 0.1, 0.22), ""),
        ((0.3, 0.3, 0.3, 0.3, 0.3, 0.3), ""),
    ],
)
def test_a_camera_or_light_that_stands_out_is_named(errors: tuple[float, ...], sentence: str) -> None:
    told = standing_out(PLACES, errors)
    assert told.startswith(sentence)
    assert bool(told) == bool(sentence)


def test_one_camera_is_not_named_beside_a_single_other() -> None:
    assert standing_out([("f0", "l0"), ("b0", "l0")], (0.5, 0.01)) == ""
