"""The texture set of a tooth: enamel thickness with its standard error, stains and colour."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from services.anatomy.templates.incisor import build_incisor
from services.assets.content import read_content
from services.assets.exporters import export_to
from services.assets.fitted_job import fitted_dentins
from services.assets.textures.job import bake_textures
from services.assets.textures.texels import texels_of
from services.assets.textures.thickness import thicknesses
from services.core.files.meshes import write_mapped_mesh, write_mesh
from services.core.geometry import Mesh, Tooth
from services.core.records import JobSpec
from services.core.results import FitReport, PreparedManifest
from services.core.store import StageWriter
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.layer_reflectance import layer_reflectance
from services.transport.optics.parameters import Medium
from services.transport.scene.stain_uv import bilinear_texels, stain_layout
from services.transport.thickness import uncertain_thickness
from tests.support.prepared import camera, sphere
from tests.unit.test_exporters import COEFFICIENTS, published

RADII_MM = (4.0, 3.0)
ENAMEL, DENTIN = Medium(5.0, 0.99, g1=0.7), Medium(12.0, 0.98, g1=0.75)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = published(tmp_path_factory.mktemp("job"))
    export_to(root, ("gltf",))
    return root


def plane(path: Path, name: str = "Y") -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.array(file.channels()[name].pixels)


def told(root: Path, exporter: str = "gltf") -> tuple[Path, dict[str, Any]]:
    folder = root / f"asset-{exporter}" / "textures"
    return folder, json.loads((folder / "textures.json").read_text())["tooth_11_enamel"]


def test_every_point_of_the_surface_has_its_texel(job: Path) -> None:
    mesh = read_content(job).parts[0].mesh
    texels = texels_of(mesh)
    # Points of the chords lie within their sagitta of the sphere.
    radii = np.linalg.norm(texels.points_mm, axis=1)
    assert radii.max() < RADII_MM[0] + 1e-5
    assert radii.min() > np.linalg.norm(sphere(4.0).vertices_mm[sphere(4.0).faces].mean(axis=1), axis=1).min() - 1e-5
    # The number of texels times their area is the surface, but for those cut by the edges of charts.
    _, said = told(job)
    a, b = (mesh.vertices_mm[mesh.faces[:, k]] - mesh.vertices_mm[mesh.faces[:, 0]] for k in (1, 2))
    area = np.linalg.norm(np.cross(a, b), axis=1).sum() / 2
    assert len(texels.points_mm) * said["texel_mm"] ** 2 == pytest.approx(area, rel=0.02)
    assert said["texel_mm"] == pytest.approx(0.1, rel=0.02)
    low, high = said["texel_mm_5_to_95_percent"]
    assert 0.08 < low < said["texel_mm"] < high < 0.12
    # Texels outside of the charts take the value of a near one.
    assert texels.index.shape == (said["size"][1], said["size"][0])
    assert texels.index.min() == 0


def test_thickness_is_that_of_two_spheres(job: Path) -> None:
    folder, said = told(job)
    values = plane(folder / said["thickness"]["exr"])
    # Chords of triangles with edges of 0.3 rad lie up to 2 % of the radius inside.
    assert 1.0 - 0.02 * 4.0 < values.min() <= values.max() < 1.0 + 0.02 * 3.0
    counts = np.array(Image.open(folder / said["thickness"]["png"]))
    np.testing.assert_allclose(counts * said["thickness"]["png_mm_per_count"], values, atol=0.51e-4)
    assert said["thickness_se"] == {"absent": "The fit that made the asset is not in the job's folder."}


def test_colour_is_that_of_the_layers(job: Path) -> None:
    folder, said = told(job)
    depth = plane(folder / said["thickness"]["exr"]).astype(float)
    picture = np.array(Image.open(folder / said["base_colour"]["png"])) / 255
    for k, own in enumerate(COEFFICIENTS.values()):
        medium = Medium(own["sigma"], own["alpha"], g1=own["g1"])
        linear = plane(folder / said["base_colour"]["exr"], "RGB"[k])
        # Enamel and dentin of this asset are the same medium, so the layer is not seen.
        np.testing.assert_allclose(linear, half_space_reflectance(medium), rtol=1e-6)
        curved = 1.055 * linear ** (1 / 2.4) - 0.055
        np.testing.assert_allclose(picture[..., k], curved, atol=0.51 / 255)
    assert depth.shape == picture.shape[:2]


def test_a_layer_has_the_reflectance_of_its_limits() -> None:
    ground = half_space_reflectance(DENTIN)
    found = layer_reflectance(ENAMEL, np.array([0.0, 1e3]), ground)
    np.testing.assert_allclose(found, [ground, half_space_reflectance(ENAMEL)], rtol=1e-12)
    between = layer_reflectance(ENAMEL, np.linspace(0, 5, 20), ground)
    assert (np.diff(between) > 0).all()
    # Without absorption a layer on black reflects s / (1 + s), s = 3/4 sigma_s' d; the formula goes there smoothly.
    for alpha in (1.0, 1 - 1e-9):
        white = layer_reflectance(Medium(4.0, alpha, g1=0.5), np.array([1.0]), 0.0)
        assert white[0] == pytest.approx(1.5 / 2.5, rel=1e-4)
    black = layer_reflectance(Medium(1.0, 0.0), np.array([0.5]), 0.3)
    assert black[0] == pytest.approx(0.3 * np.exp(-2.0), rel=1e-12)


def test_stains_lie_in_the_chart_of_the_fit_and_darken_the_colour(tmp_path: Path) -> None:
    outer = sphere(4.0)
    layout = stain_layout(outer, 1.0)
    stain = layout.texture(np.where(layout.points_mm[:, 2] > 0, 0.7, 0.0)).transmittance

    def stained(writer: StageWriter) -> None:
        write_mapped_mesh(writer.folder / "teeth/11/outer.ply", outer, layout.corners_uv)
        np.save(writer.folder / "teeth/11/stain_green.npy", stain.astype(np.float32))
        np.save(writer.folder / "teeth/11/stain_green_se.npy", (0.1 * stain).astype(np.float32))

    root = published(tmp_path, before=stained, rig={"views": {}})
    export_to(root, ("gltf", "usd", "blender"))
    folder, said = told(root)
    part = read_content(root).parts[0]
    times = part.mesh.size[0] / stain.shape[0]
    assert times == int(times) > 5
    texels = texels_of(part.mesh)
    values = plane(folder / said["stain"]["exr"], "green")
    place, weight = bilinear_texels(texels.uv, (stain.shape[0], stain.shape[1]))
    np.testing.assert_allclose(values, texels.picture((stain.reshape(-1)[place] * weight).sum(axis=1)), rtol=1e-6)
    # Standard errors are interpolated as the transmittances are.
    np.testing.assert_allclose(plane(folder / said["stain_se"]["exr"], "green"), 0.1 * values, rtol=1e-5)
    counts = np.array(Image.open(folder / said["stain_se"]["png"]["green"])) / 65535
    np.testing.assert_allclose(counts, 0.1 * values, atol=0.51 / 65535)
    assert "with the media as they were fitted" in said["stain_se"]["meaning"]
    height = texels.picture(texels.points_mm[:, 2])
    # Half a texel of 1 mm around the border is of both kinds.
    np.testing.assert_allclose(values[height > 1.5], np.exp(-0.7), rtol=1e-6)
    np.testing.assert_allclose(values[height < -1.5], 1.0, rtol=1e-6)
    colour = {name: plane(folder / said["base_colour"]["exr"], name) for name in "RGB"}
    dark = colour["G"][height > 1.5].mean() / colour["G"][height < -1.5].mean()
    assert dark == pytest.approx(np.exp(-1.4), rel=1e-5)
    assert np.ptp(colour["R"]) < 1e-6
    # Every export has the same set.
    for exporter in ("usd", "blender"):
        other, same = told(root, exporter)
        assert same == said
        for file in sorted(path.name for path in folder.iterdir()):
            assert (other / file).read_bytes() == (folder / file).read_bytes()


def test_stains_of_an_earlier_fit_have_no_standard_error(tmp_path: Path) -> None:
    outer = sphere(4.0)
    layout = stain_layout(outer, 2.0)

    def stained(writer: StageWriter) -> None:
        write_mapped_mesh(writer.folder / "teeth/11/outer.ply", outer, layout.corners_uv)
        np.save(writer.folder / "teeth/11/stain_green.npy", np.full(layout.index.shape, 0.5, dtype=np.float32))

    root = published(tmp_path, before=stained)
    export_to(root, ("gltf",))
    _, said = told(root)
    assert said["stain_se"] == {"absent": "The fit was made before stains had a standard error; make it again."}


def test_thickness_has_the_standard_error_of_the_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.assets.content.TEXEL_MM", 0.4)  # a sixteenth of the texels, and of the time
    tooth = build_incisor(columns=24)
    weights, covariance = (0.4, 0.5, 0.3), np.diag([0.05, 0.04, 0.06]) ** 2
    prepared = StageWriter(tmp_path, "prepared", 1)
    write_mesh(prepared.folder / "teeth/11/outer.ply", tooth.outer)
    manifest = PreparedManifest(
        channels=("red", "green", "blue"), cameras=(camera("c0"),), lights=(), held_out=(), fdi=(11,), dentin_known=(),
        median_motion_px=None, valid_fraction=1.0,
    )  # fmt: skip
    prepared.publish(manifest)
    report = FitReport(
        converged=True, advice="", parameters={}, fit_error={}, held_out_error={}, fit_error_se={}, steps=1,
        shape=weights, shape_covariance=tuple(map(tuple, covariance.tolist())), seconds=1.0,
    )  # fmt: skip
    StageWriter(tmp_path, "fit", 1).publish(report)
    spec = JobSpec(capture=tmp_path, dentin="fit")
    ((fitted, shape, _),) = fitted_dentins(tmp_path / "prepared", manifest, spec, report)
    assert shape is not None
    # Blending a shape takes seconds, and is the same each time.
    monkeypatch.setattr("services.assets.textures.thickness.fitted_dentins", lambda *_: [(fitted, shape, weights)])
    dentin = Mesh(shape.vertices_mm(weights), shape.base.faces)
    published(tmp_path, fitted.outer, dentin=dentin)

    content = read_content(tmp_path)
    baked = bake_textures(tmp_path, spec, content)["tooth_11_enamel"]
    assert baked.thickness_mm is not None
    assert baked.thickness_se_mm is not None
    texels = texels_of(content.parts[0].mesh)
    some = np.random.default_rng(1).integers(0, len(texels.points_mm), 200)
    expected = uncertain_thickness(texels.points_mm[some], shape, np.array(weights), covariance)
    first = [np.flatnonzero(texels.index.reshape(-1) == k)[0] for k in some]
    at = np.unravel_index(np.array(first), texels.index.shape)
    np.testing.assert_allclose(baked.thickness_mm[at], expected.values_mm, rtol=1e-9)
    np.testing.assert_allclose(baked.thickness_se_mm[at], expected.errors_mm, rtol=1e-9)
    assert expected.errors_mm.max() > 0.01

    # A dentin of another fit, or options that are not known, tell no standard error; the thickness stays.
    other = Tooth(11, fitted.outer, moved(dentin))
    for known, one in ((spec, other), (None, Tooth(11, fitted.outer, dentin))):
        thickness = thicknesses(tmp_path, known, (one,))[11]
        assert thickness.at(texels.points_mm[:5])[1] is None
        assert thickness.why_no_se == "The fit that made the asset is not in the job's folder."


def moved(dentin: Mesh) -> Mesh:
    centre = dentin.vertices_mm.mean(axis=0)
    return Mesh(centre + 0.95 * (dentin.vertices_mm - centre), dentin.faces)
