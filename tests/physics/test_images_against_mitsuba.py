"""Images against stock Mitsuba's ``prbvolpath`` on the same nested scene, pixel by pixel.

z-scores come from 16 batches a side, mapped through Student's t with Welch's degrees of freedom. The count beyond 3 stays
below its 99.9 % binomial quantile, |mean z| below 4 standard errors, and the rms within 0.9 to 1.1 (of fewer than 500 values:
within what chi-square leaves with probability 1e-3). An honest engine fails one run in 500; seeds are fixed. The lights of a
pixel share its walks, so the standard error of the mean is that of the pixels' own means.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from services.core.meshfiles import read_teeth, write_mesh
from services.core.records import Boundary, FolderCapture
from services.core.store import read_record
from services.fit.export.mitsuba_scene import load_scene, nested_scene, render_batches
from services.fit.optics.parameters import Medium, Tissue
from services.fit.transport.engine import Engine
from services.fit.transport.platform import prepare_device
from services.fit.transport.recipe import DentinShape, SceneRecipe
from tests.support.shared_data import shared_path
from tests.support.small_tooth import INTENSITY, LIGHTS_MM, SEMI_AXES_MM, camera_at, dentin_shape, ellipsoid, whole_view
from tests.support.z_scores import rms_bounds, student_to_normal

BATCHES = 16
TISSUE = Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5))


def pixel_scores(means: list[NDArray[np.float64]], variances: list[NDArray[np.float64]], block: int = 1) -> NDArray[np.float64]:
    """z of two sides' images (lights, H, W), summed over blocks of pixels, NaN where unlit; variances are of means over BATCHES."""
    means = [sum_blocks(mean, block) for mean in means]
    squares = [sum_blocks(variance**2, block) for variance in variances]
    total = sum_blocks(variances[0] + variances[1], block)
    lit = total > 0
    freedom = (BATCHES - 1) * total[lit] ** 2 / (squares[0] + squares[1])[lit]
    z = np.full(total.shape, np.nan)
    z[lit] = student_to_normal((means[0] - means[1])[lit] / np.sqrt(total[lit]), freedom)
    return z


def sum_blocks(images: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    *others, height, width = images.shape
    cut = images[..., : height // block * block, : width // block * block]
    return cut.reshape(*others, height // block, block, width // block, block).sum(axis=(-3, -1))


def require_same_pictures(scores: NDArray[np.float64], least: int) -> None:
    z = scores[np.isfinite(scores)]
    of_pixels = np.array([row[np.isfinite(row)].mean() for row in scores.reshape(len(scores), -1).T if np.isfinite(row).any()])
    assert len(z) >= least
    assert abs(of_pixels.mean()) < 4 * of_pixels.std(ddof=1) / np.sqrt(len(of_pixels))
    assert np.count_nonzero(np.abs(z) > 3) <= stats.binom.ppf(0.999, len(z), 2 * stats.norm.sf(3))
    low, high = rms_bounds(len(z), rule=(0.9, 1.1))
    assert low <= np.sqrt(np.mean(z**2)) <= high


@pytest.mark.parametrize("boundary", ["matched", "thin"])
def test_the_small_tooth_looks_as_in_mitsuba(boundary: Boundary, tmp_path: Path) -> None:
    prepare_device()
    # The thin boundary's plug-in shares no code with the engine.
    importlib.import_module("services.fit.export.shipped.thin_boundary").register()
    outer, shape = ellipsoid(SEMI_AXES_MM), dentin_shape()
    core = shape.vertices_mm((0.5, 0.4))
    dentin = DentinShape(type(outer)(core, outer.faces), np.zeros((0, len(core), 3)))
    camera = camera_at((0.2, 1, 0.1), size=16, span_mm=5.0)
    write_mesh(tmp_path / "outer.ply", outer)
    write_mesh(tmp_path / "dentin.ply", dentin.base)
    lights = LIGHTS_MM[[1, 3]]
    scene = SceneRecipe(outer, dentin, lights, np.full(2, INTENSITY), boundary)
    ours = Engine(scene).images(TISSUE, whole_view(camera), samples=2048, seed=21, batches=BATCHES)
    scores = []
    for number, light in enumerate(lights):
        teeth = {"11": (tmp_path / "outer.ply", tmp_path / "dentin.ply")}
        stock = load_scene(nested_scene(teeth, TISSUE, (camera,), light, INTENSITY, boundary=boundary))
        mean, variance = render_batches(stock, 0, samples=2048, seed=31 + number, batches=BATCHES)
        scores.append(pixel_scores([ours.mean[number].reshape(mean.shape), mean], [ours.variance[number].reshape(mean.shape), variance]))
    require_same_pictures(np.stack(scores), least=500)


@pytest.mark.parametrize(
    ("samples", "block", "least"), [pytest.param(1024, 4, 250, id="blocks"), pytest.param(16384, 1, 3000, id="pixels", marks=pytest.mark.slow)]
)
def test_the_scanned_incisor_looks_as_in_mitsuba(samples: int, block: int, least: int) -> None:
    # Pixels of few paths are skewed, which no t-distribution corrects, and their lights move together; blocks of them are not, and many paths leave the
    # truth's own noise, which is independent.
    root = shared_path("data/tooth-ur1-truth")
    capture, tooth = read_record(root / "capture.json", FolderCapture), read_teeth(root)[0]
    truth = json.loads((root / "truth.json").read_text())
    enamel, inner = truth["enamel"], truth["dentin"]
    tissue = Tissue(
        Medium(enamel["sigma_t"], enamel["albedo"], enamel["beta"], enamel["g1"], enamel["g2"]), Medium(inner["sigma_t"], inner["albedo"], g1=inner["g"])
    )
    assert tooth.dentin is not None
    dentin = DentinShape(tooth.dentin, np.zeros((0, len(tooth.dentin.vertices_mm), 3)))
    lights = np.array([light.position_mm for light in capture.lights])
    engine = Engine(SceneRecipe(tooth.outer, dentin, lights, np.array([light.intensity[0] for light in capture.lights])))
    camera = capture.cameras[0]
    ours = engine.images(tissue, whole_view(camera), samples=samples, seed=41, batches=BATCHES)
    stems = [root / f"{camera.name}_{light.name}" for light in capture.lights]
    stock, variance = (np.stack([np.load(f"{stem}{part}.npy").squeeze() for stem in stems]).astype(np.float64) for part in ("", "_var"))
    z = pixel_scores([ours.mean.reshape(stock.shape), stock], [ours.variance.reshape(stock.shape), variance], block)
    require_same_pictures(z, least)
