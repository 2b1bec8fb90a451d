"""Dictionaries for a slab's fit: phase functions, derivatives by the weights, known mixtures found again, and what is
refused.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from services.core.errors import CaptureInputError, SettingsError
from services.core.records import JobSpec
from services.core.results import Estimate
from services.core.slab.dictionaries import DICTIONARIES
from services.core.slab.folder import SlabFolder, read_folder
from services.slab.cell.dictionary import ANGLES_RAD, cosine_moments, hg_values, tent_solid_angles
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.cell.single import single_scattering
from services.slab.dictionaries.chosen import ChosenDictionary, dictionary_of
from services.slab.dictionaries.mie import scattered
from services.slab.fit import fit_slab, write_results
from services.slab.options import SlabOptions
from services.slab.read.diagnosis import misfit_faults
from services.slab.results.result import SlabFit
from services.slab.results.stored import fingerprint
from services.slab.solve.mixture import Mixture, Mixtures, unit_atoms
from services.slab.solve.normal import derivative_rows
from services.slab.solve.weights import smoothed_variance
from services.transport.numerics import numerics_name
from tests.support.shared_data import shared_path
from tests.support.small_slab import WAVELENGTH_NM, description, small_rig, write_folder

OPTIONS = {
    "tents": SlabOptions(),
    "hg": SlabOptions(dictionary="hg"),
    "mie": SlabOptions(dictionary="mie", particle_index=1.6),
    "table": SlabOptions(dictionary="table"),
}
ABSORPTION_PER_MM = 0.05


def write_table(root: Path) -> Path:
    """Three atoms at 91 angles."""
    angles = np.linspace(0, 180, 91)
    columns = [np.interp(np.radians(angles), ANGLES_RAD, hg_values(g)) for g in (-0.5, 0.3, 0.8)]
    with (root / "dictionary.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["angle_deg", "dust", "glass beads", "oil"])
        writer.writerows(np.stack([angles, *columns], axis=1).tolist())
    return root


def dictionary_named(name: str, root: Path) -> tuple[ChosenDictionary, Mixtures]:
    dictionary = dictionary_of(root, SlabFolder.model_validate(description()), WAVELENGTH_NM, OPTIONS[name])
    assert isinstance(dictionary.coordinates, Mixtures)
    return dictionary, dictionary.coordinates


def write_truth(root: Path, material: Mixture) -> Path:
    """A cell with this material and 1 % noise; the variances include the walk's own noise."""
    told, noise = description(), np.random.default_rng(5)
    told["images"] = [image | {"variance_file": f"var_{image['file']}"} for image in told["images"]]
    folder = SlabFolder.model_validate(told)
    rig = rig_of(folder, WAVELENGTH_NM)
    batches = render(rig, material, seed=77, step=0, batches=8, paths=4000, scores=False)
    of_walk = smoothed_variance(batches.images, (rig.grid.rows, rig.grid.columns))
    (root / "slab.json").write_text(json.dumps(told))
    for entry, image, variance in zip(folder.images, batches.mean, of_walk, strict=True):
        whole, of_whole = (mirrored(one.reshape(rig.grid.rows, rig.grid.columns)) for one in (image, variance))
        shot = 0.01**2 * whole * whole.mean()
        np.save(root / entry.file, whole + np.sqrt(shot) * noise.normal(size=whole.shape))
        # Both halves share the walk's noise, but are treated as independent.
        np.save(root / str(entry.variance_file), shot + 2 * of_whole)
    return root


def mirrored(half: np.ndarray) -> np.ndarray:
    return np.concatenate([half[::-1], half])


def test_every_dictionary_is_made_of_phase_functions(tmp_path: Path) -> None:
    assert set(OPTIONS) == set(DICTIONARIES)
    for name in ("hg", "mie", "table"):
        dictionary, mix = dictionary_named(name, write_table(tmp_path))
        assert len(set(dictionary.names)) == mix.atoms.shape[1]
        assert (mix.atoms > 0).all()
        assert tent_solid_angles() @ mix.atoms == pytest.approx(np.ones(mix.atoms.shape[1]), rel=1e-12)


def test_spheres_scatter_as_the_reference_says() -> None:
    # Printed to 5e-5. A mean cosine from tents of 0.9 degrees is off by up to 1e-3 where the peak is 10 degrees wide.
    with shared_path("reference/mie_dispersions.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        relative, size = float(row["n_polystyrene"]) / float(row["n_water"]), float(row["size_parameter"])
        intensity, efficiency = scattered(complex(relative), size)
        diameter_mm = float(row["diameter_nm"]) * 1e-6
        per_mm = float(row["volume_fraction"]) * 1.5 * efficiency / diameter_mm
        assert per_mm == pytest.approx(float(row["mu_s_per_mm"]), rel=3e-4)  # the size parameter has five digits
        g = float(cosine_moments() @ intensity / (tent_solid_angles() @ intensity))
        assert g == pytest.approx(float(row["g"]), abs=1e-3)


def test_absorbing_spheres_scatter_less() -> None:
    assert scattered(1.2 + 0.05j, 5.0)[1] < scattered(1.2 + 0j, 5.0)[1]


def test_small_spheres_scatter_as_rayleigh_said() -> None:
    intensity, efficiency = scattered(complex(1.2), 0.01)
    polarisability = (1.2**2 - 1) / (1.2**2 + 2)
    assert efficiency == pytest.approx(8 / 3 * 0.01**4 * polarisability**2, rel=1e-3)  # next order: size squared
    shape = 1 + np.cos(ANGLES_RAD) ** 2
    assert intensity / intensity[0] == pytest.approx(shape / 2, rel=1e-3)


@pytest.mark.parametrize("name", ["hg", "mie", "table"])
def test_derivatives_by_weights_agree_with_differences(name: str, tmp_path: Path) -> None:
    # Single scattering is computed by quadrature, so differences are exact except for their third order, 1e-6 of 2e-3
    # squared.
    _, mix = dictionary_named(name, write_table(tmp_path))
    rig, rng = small_rig(), np.random.default_rng(3)
    x = np.append(rng.random(mix.atoms.shape[1]) / mix.atoms.shape[1], 0.1)
    direction = rng.normal(size=len(x)) / len(x)
    rows = single_scattering(rig, mix.material_at(x), scores=True)[1]
    slope = derivative_rows(rows, mix.material_at(x)) @ mix.chain(mix.material_at(x)) @ direction
    step = 2e-3
    ahead, behind = (single_scattering(rig, mix.material_at(x + s * direction), scores=False)[0] for s in (step, -step))
    assert slope == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-6 * np.abs(slope).max())


def test_derivatives_of_all_orders_by_weights_agree_with_differences() -> None:
    # For all light that the cameras see, within 5 standard errors: 6e-7 by chance. The same random streams on both
    # sides of a difference cancel most of their noise.
    mix, rig = Mixtures(unit_atoms(np.stack([hg_values(g) for g in (-0.3, 0.8)], axis=1))), small_rig()
    x, step = np.array([0.5, 1.5, 0.1]), 0.05

    def seen(x: np.ndarray) -> np.ndarray:
        images = render(rig, mix.material_at(x), seed=4, step=1, batches=8, paths=2000, scores=False).images
        return np.asarray(images.sum(axis=(1, 2)))

    batches = render(rig, mix.material_at(x), seed=4, step=0, batches=8, paths=3000, scores=True)
    slopes = (derivative_rows(batches.rows, mix.material_at(x)) @ mix.chain(mix.material_at(x))).sum(axis=(1, 2))
    largest = np.abs(slopes.mean(axis=0)).max()
    for atom, moved in enumerate(step * np.eye(3)):
        differences = (seen(x + moved) - seen(x - moved)) / (2 * step)
        error = math.hypot(slopes[:, atom].std() / math.sqrt(7), differences.std() / math.sqrt(7))
        assert error < 0.05 * largest
        assert slopes[:, atom].mean() == pytest.approx(differences.mean(), abs=5 * error)


Fitted = Callable[[str, dict[int, float], float], tuple[SlabFit, Mixture, ChosenDictionary]]


@pytest.fixture
def fitted(tmp_path: Path) -> Fitted:
    """Fits a cell whose material is a mixture of the dictionary's own atoms."""

    def fit(name: str, parts: dict[int, float], effort: float) -> tuple[SlabFit, Mixture, ChosenDictionary]:
        dictionary, mix = dictionary_named(name, write_table(tmp_path))
        x = np.zeros(mix.atoms.shape[1] + 1)
        x[list(parts)], x[-1] = list(parts.values()), ABSORPTION_PER_MM
        truth = mix.material_at(x)
        (found,) = fit_slab(write_truth(tmp_path, truth), OPTIONS[name].model_copy(update={"effort": effort}))
        return found, truth, dictionary

    return fit


@pytest.mark.parametrize(
    ("name", "parts", "effort"),
    [
        # Slow: the fit goes the way of a table's, whose atoms are phase functions of Henyey and Greenstein too.
        pytest.param("hg", {4: 0.3, 10: 0.9}, 0.02, marks=pytest.mark.slow),
        # Light from the largest spheres is hard to separate from light that was not scattered, which needs more paths.
        ("mie", {45: 1.2}, 0.1),
        ("table", {0: 0.2, 1: 0.4, 2: 0.6}, 0.02),
    ],
)
def test_a_mix_of_a_dictionary_is_found(
    name: str,
    parts: dict[int, float],
    effort: float,
    fitted: Fitted,
    tmp_path: Path,
) -> None:
    found, truth, dictionary = fitted(name, parts, effort)
    told, sigma_s, g = found.parameters, truth.scattering_per_mm, truth.mean_cosine
    # Within 4.5 of the stated standard errors, which are at most 10 % of the values.
    for got, true in ((told.sigma_s, sigma_s), (told.sigma_s_reduced, sigma_s * (1 - g))):
        assert abs(got.value - true) <= 4.5 * got.se
        assert got.se <= 0.1 * true
    assert found.dictionary == name
    phase, true_phase = np.array(found.phase.value_per_sr), truth.phase_per_sr
    assert np.sqrt(((phase - true_phase) ** 2).sum() / (true_phase**2).sum()) < 0.15
    for k, atom in enumerate(dictionary.names):
        got = found.atoms[f"atoms.{atom}"]
        assert abs(got.value - parts.get(k, 0.0)) <= 4.5 * got.se
    assert not any("nearest mix" in note for note in found.notes)

    # All of these can be read like any other estimate.
    write_results((found,), tmp_path)
    written = json.loads((tmp_path / "parameters.json").read_text())["532"]
    assert {f"atoms.{atom}" for atom in dictionary.names} <= written.keys()
    assert all(Estimate.model_validate(one).se is not None for one in written.values())
    if dictionary.spheres is not None:
        assert written["mean_radius"]["unit"] == "um"
        volume = written["volume_fraction"]
        true_volume = 1.2 * float(dictionary.spheres.volume_mm[45])
        assert abs(volume["value"] - true_volume) <= 4.5 * volume["se"]


def test_a_material_that_is_no_mix_is_told() -> None:
    assert misfit_faults("hg", 520.0, 5.0, 1000, converged=True) == ()
    (sentence,) = misfit_faults("hg", 2000.0, 5.0, 1000, converged=True)
    assert sentence.startswith("The images differ from the nearest mix of dictionary hg by 2 times their noise")


def test_images_that_differ_from_a_fit_by_tents_are_told() -> None:
    assert misfit_faults("tents", 1000.0, 5.0, 1000, converged=True) == ()
    (sentence,) = misfit_faults("tents", 72_000.0, 5.0, 1000, converged=True)
    assert sentence.startswith("The images differ from the fit by 12 times their noise")
    assert ": check their variances, and the cell," in sentence
    (sentence,) = misfit_faults("tents", 72_000.0, 5.0, 1000, converged=False)
    assert ": let the fit converge first, and then check their variances" in sentence


def saved(array: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.save(path.with_suffix(".npy"), array)


def written(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(text.encode("latin-1"))


ANGLES = np.linspace(0, 180, 5)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda _: None,
        "holds no dictionary.csv or dictionary.npy, which dictionary = table is read from; put one there."),
        (written(""), "the first line must name the columns, the first of them angle_deg."),
        (written("theta,a\n0,1\n180,1\n"), "the first line must name the columns, the first of them angle_deg."),
        (written("angle_deg\n0\n180\n"), "has 0 atoms; give 1 to 200, each a column after the angles."),
        (written("angle_deg,a,a\n0,1,1\n180,1,1\n"), "called 'a'; rename it."),
        (written("angle_deg,a\n0,1\n90,1,2\n180,1\n"), "line 3 has 3 values and the first line 2"),
        (written("angle_deg,a\n0,1\n90,x\n180,1\n"), "line 3 holds what is no number"),
        (written("angle_deg,a\n0,1\n90,nan\n180,1\n"), "holds a value that is not finite"),
        (written("angle_deg,a\n0,1\n"), "angles must rise from 0 to 180 degrees in the first column."),
        (written("angle_deg,a\n0,1\n90,1\n80,1\n180,1\n"), "angles must rise from 0 to 180 degrees"),
        (written("angle_deg,a\n1,1\n180,1\n"), "angles must rise from 0 to 180 degrees"),
        (written("angle_deg,a\n0,1\n90,-1\n180,1\n"),
        "atom a is negative at 90 degrees; a phase function is never below"),
        (written("angle_deg,a,b\n0,1,0\n180,1,0\n"), "atom b scatters nowhere; remove its column."),
        (written("angle_deg,\xe9\n0,1\n180,1\n"), "cannot be read ("),
        (saved(np.ones(5)), "holds float64 (5,) instead of floats (angles, 1 + atoms); save it as such."),
        (saved(np.ones((3, 2), dtype=int)), "instead of floats (angles, 1 + atoms)"),
        (saved(np.stack([ANGLES] + [ANGLES + 1] * 201, axis=1)), "has 201 atoms; give 1 to 200"),
        (lambda path: path.with_suffix(".npy").write_bytes(b"no array"), "cannot be read ("),
    ],
)  # fmt: skip
def test_a_bad_table_is_refused_in_a_sentence(make: Callable[[Path], None], sentence: str, tmp_path: Path) -> None:
    make(tmp_path / "dictionary.csv")
    with pytest.raises(CaptureInputError) as refused:
        dictionary_named("table", tmp_path)
    assert sentence in str(refused.value)
    assert str(refused.value).endswith(".")


def test_two_tables_are_refused(tmp_path: Path) -> None:
    np.save(write_table(tmp_path) / "dictionary.npy", np.stack([ANGLES, ANGLES + 1], axis=1))
    with pytest.raises(CaptureInputError, match=r"holds both dictionary\.csv and dictionary\.npy; remove one\."):
        dictionary_named("table", tmp_path)


def test_an_array_is_read_as_a_table(tmp_path: Path) -> None:
    np.save(tmp_path / "dictionary.npy", np.stack([ANGLES, ANGLES + 1], axis=1))
    assert dictionary_named("table", tmp_path)[0].names == ("1",)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"dictionary": "vmf"}, "dictionary 'vmf' is not known; known are hg, mie, table, tents"),
        ({"dictionary": "mie"}, "dictionary = mie needs particle_index"),
        ({"particle_index": 1.6}, "particle_index is an option of dictionary = mie"),
        ({"particle_absorption": 0.1}, "particle_absorption is an option of dictionary = mie"),
    ],
)
def test_options_that_make_no_dictionary_are_refused(options: dict[str, object], sentence: str) -> None:
    for record, others in ((JobSpec, {"kind": "slab", "capture": "cell"}), (SlabOptions, {})):
        with pytest.raises(ValidationError, match=sentence):
            record.model_validate(others | options)


def test_a_dictionary_that_this_process_does_not_know_is_refused(tmp_path: Path) -> None:
    newer = SlabOptions().model_copy(update={"dictionary": "newer"})
    with pytest.raises(SettingsError, match=r"dictionary 'newer' is not known; known are hg, mie, table, tents\."):
        dictionary_of(tmp_path, SlabFolder.model_validate(description()), WAVELENGTH_NM, newer)


def test_what_the_first_version_kept_is_still_taken(tmp_path: Path) -> None:
    root = write_folder(tmp_path, description())
    folder, digest = read_folder(root), hashlib.sha256()
    # The first version knew no exposures, and nothing of a camera's counts.
    described = folder.model_dump_json(exclude={"exposures": True, "cameras": {"__all__": {"counts"}}})
    assert '"counts"' not in described
    assert '"exposures"' not in described
    for part in (numerics_name(), described, '{"seed":1,"effort":1.0}', f"{WAVELENGTH_NM:g}"):
        digest.update(part.encode() + b"\n")
    for image in folder.images:
        digest.update(hashlib.sha256((root / image.file).read_bytes()).digest() + b"none")
    assert fingerprint(root, WAVELENGTH_NM, SlabOptions()) == digest.hexdigest()
    others = {fingerprint(root, WAVELENGTH_NM, OPTIONS[name]) for name in ("hg", "mie")}
    assert len(others | {digest.hexdigest()}) == 3


def test_a_table_that_changed_is_fitted_again(tmp_path: Path) -> None:
    root = write_table(write_folder(tmp_path, description()))
    before = fingerprint(root, WAVELENGTH_NM, OPTIONS["table"])
    with (root / "dictionary.csv").open("a") as stream:
        stream.write("\n")
    assert fingerprint(root, WAVELENGTH_NM, OPTIONS["table"]) != before
