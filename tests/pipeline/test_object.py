"""A job of kind object: from a virtual capture to the report and asset, without teeth; and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from services.assets.stage import export
from services.core.errors import CaptureInputError, InputError, MeshError
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture, JobSpec
from services.core.results import FitReport
from services.core.stage import LocalContext, StageEvent
from services.core.store import read_record, write_record
from services.fit.stage import run
from services.phantom.object import object_surfaces, outer_surface, write_object_phantom
from services.preprocess.stage import run_object
from tests.support.command_line import dentine
from tests.support.computed_once import folder_once
from tests.support.prepared import FAKE
from tests.support.prepared import sphere as ball

SMALL: dict[str, Any] = {"pixel_mm": 1.6, "cameras": 1, "lights": 1, "samples": 16, "held_out": 0}


def spec_for(capture: Path, **options: Any) -> JobSpec:
    quick: dict[str, Any] = {"max_steps": 1, "search_candidates": 800, "samples_per_pixel": 32, "boundary": "matched"}
    return JobSpec(kind="object", capture=capture, instrument="off", **(quick | options))


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One image of a homogeneous sphere under one light; nobody may change it."""
    return folder_once(tmp_path_factory, "object-sphere", lambda folder: write_object_phantom(folder, **SMALL))


def fitted(capture: Path, job: Path, **options: Any) -> tuple[FitReport, list[StageEvent]]:
    """A fit, by the fake engine, of a capture that is prepared and exported as it is in a job."""
    events, spec = list[StageEvent](), spec_for(capture, **options)
    context = LocalContext(job, 1, events.append)
    run_object(spec, context)
    report = run(spec, context, engine=FAKE)
    export(spec, LocalContext(job))
    return report, events


def test_one_image_of_a_sphere_becomes_an_asset_without_teeth(sphere: Path, tmp_path: Path) -> None:
    report, events = fitted(sphere, tmp_path)
    table = report.parameters["green"]
    assert {"body.sigma_s_reduced", "body.sigma_a"} <= table.keys()
    assert {name.partition(".")[0] for name in table} == {"body"}
    assert report.held_out_error == {}
    steps = [event.data for event in events if event.kind == "step"]
    assert {name.partition(".")[0] for step in steps for name in step["parameters"]} == {"body"}
    asset = tmp_path / "asset"
    assert (asset / "object" / "outer.ply").is_file()
    assert not (asset / "teeth").exists()
    assert "body.sigma_a" in json.loads((asset / "parameters.json").read_text())["green"]
    # The asset's scene holds the fitted body, not the empty medium of a part that was not modelled.
    numbers = [float(one) for one in re.findall(r'value="([\d.e+-]+)"', (asset / "scene_green.xml").read_text())]
    assert any(number == pytest.approx(table["body.sigma"].value, rel=1e-5) for number in numbers)
    page = (tmp_path / "report.html").read_text()
    assert "<h1>Object" in page or "<title>Object" in page
    text = re.sub(r"<style.*?</style>|data:[^\"']*", "", page, flags=re.DOTALL)
    assert not re.findall(r"(?i)\b(?:tooth|teeth|enamel|dentin)\b", text)


def test_paired_cameras_see_a_light_each(tmp_path: Path) -> None:
    write_object_phantom(tmp_path, is_paired=True, **SMALL | {"cameras": 2, "lights": 2})
    images = read_record(tmp_path / "capture.json", FolderCapture).images
    assert [(image.camera, image.light) for image in images] == [("c0", "l0"), ("c1", "l1")]
    # The second camera's image is that of its own light.
    both = tmp_path / "both"
    write_object_phantom(both, **SMALL | {"cameras": 2, "lights": 2})
    own, all_lights = (np.load(folder / "c1_l1.npy") for folder in (tmp_path, both))
    assert own.sum() == pytest.approx(all_lights.sum(), rel=0.3)
    with pytest.raises(InputError, match="1 cameras and 2 lights are no pairs; give as many of both"):
        write_object_phantom(tmp_path, is_paired=True, **SMALL | {"lights": 2})


def test_a_core_keeps_its_place_in_its_shape(tmp_path: Path) -> None:
    shift, off = np.array([30.0, -20.0, 10.0]), np.array([1.0, 0.0, 0.0])
    for name, mesh, place in (("outer", ball(5.0), shift), ("core", ball(3.0), shift + off)):
        write_mesh(tmp_path / f"{name}.ply", Mesh(mesh.vertices_mm + place, mesh.faces))
    for shape, core_mm in ((str(tmp_path / "outer.ply"), off), ("sphere", shift + off)):
        solid = object_surfaces(shape, tmp_path / "core.ply")
        assert solid.dentin is not None
        for found, expected_mm in ((solid.outer, np.zeros(3)), (solid.dentin, core_mm)):
            ends_mm = found.vertices_mm.min(axis=0), found.vertices_mm.max(axis=0)
            # Single precision of lengths of some tens of mm.
            np.testing.assert_allclose(np.mean(ends_mm, axis=0), expected_mm, atol=1e-5)


def test_a_core_is_a_second_medium(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_mesh(tmp_path / "core.ply", ball(3.0))
    write_object_phantom(capture, core=tmp_path / "core.ply", **SMALL | {"lights": 2})
    assert "core" in json.loads((capture / "truth.json").read_text())["channels"]["green"]
    report, _ = fitted(capture, tmp_path / "job", held={"body.sigma": 2.0}, held_out_lights=())
    table = report.parameters["green"]
    assert {name.partition(".")[0] for name in table} == {"body", "core"}
    assert table["body.sigma"].value == 2.0
    assert table["body.sigma"].se is None
    assert table["core.sigma"].se is not None
    assert (tmp_path / "job" / "asset" / "object" / "core.ply").is_file()


def opened(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, mesh.faces[1:])


@pytest.mark.parametrize(
    ("outer", "told"),
    [
        (opened(ball(5.0)), "Mesh object/outer.ply is not watertight: 3 edges"),
        (Mesh(ball(5.0).vertices_mm, ball(5.0).faces[:, ::-1]), "Mesh object/outer.ply is inside out"),
        (Mesh(ball(5.0).vertices_mm * 1e-3, ball(5.0).faces), "outside 0.5 to 1000 mm"),
        (ball(5.0), "Light l0 stands 3 mm from the object's centre, inside its 5 mm radius"),
        (Mesh(ball(5.0).vertices_mm + np.array([400.0, 0, 0]), ball(5.0).faces), "No part of the object projects into"),
        (None, "object/outer.ply does not exist"),
    ],
)
def test_an_impossible_object_is_one_sentence(sphere: Path, tmp_path: Path, outer: Mesh | None, told: str) -> None:
    description = read_record(sphere / "capture.json", FolderCapture)
    lights = tuple(one.model_copy(update={"position_mm": (0.0, 3.0, 0.0)}) for one in description.lights)
    write_record(tmp_path / "capture.json", description.model_copy(update={"lights": lights}))
    for entry in description.images:
        for name in (entry.file, entry.variance_file or entry.file):
            (tmp_path / name).write_bytes((sphere / name).read_bytes())
    if outer is not None:
        write_mesh(tmp_path / "object" / "outer.ply", outer)
    with pytest.raises((CaptureInputError, MeshError), match=re.escape(told)) as refused:
        run_object(spec_for(tmp_path), LocalContext(tmp_path / "job"))
    assert not re.search(r"(?i)tooth|teeth", refused.value.message)


def test_options_of_teeth_are_not_those_of_an_object(sphere: Path) -> None:
    for option in ({"fdi": 11}, {"dentin": "none"}, {"stains": True}, {"prior": "literature"}):
        with pytest.raises(ValidationError, match=f"a job of kind object has no option '{next(iter(option))}'"):
            spec_for(sphere, **option)
    with pytest.raises(ValidationError, match=r"of body and core, such as body\.sigma"):
        spec_for(sphere, held={"enamel.sigma": 2.0})
    with pytest.raises(ValidationError, match=r"of enamel and dentin, such as enamel\.sigma"):
        JobSpec(capture=sphere, held={"body.sigma": 2.0})


def test_shapes_are_closed_and_others_are_refused(tmp_path: Path) -> None:
    # Volumes of the cube, and of the 1280 triangles inside the sphere, which are 0.7 % short of it.
    assert outer_surface("cube").signed_volume_mm3() == pytest.approx(1000)
    assert outer_surface("sphere").signed_volume_mm3() == pytest.approx(np.pi / 6 * 1000, rel=0.01)
    write_mesh(tmp_path / "open.ply", opened(ball(5.0)))
    with pytest.raises(MeshError, match="not watertight"):
        outer_surface(str(tmp_path / "open.ply"))
    with pytest.raises(InputError, match="Option --object names 'cone'; give sphere, cube, or"):
        outer_surface("cone")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--object", "cube", "--jaw"), "Option --jaw is for teeth; leave out either it or --object."),
        (("--object", "cube", "--gums"), "Option --gums is for teeth; leave out either it or --object."),
        (("--core", "core.ply"), "Option --core is for an object; add --object."),
        (("--object", "cube", "--boundary", "thin", "--renderer", "mitsuba"), "Stock Mitsuba has no thin boundary"),
    ],
)
def test_phantoms_of_objects_refuse_what_is_for_teeth(tmp_path: Path, arguments: tuple[str, ...], told: str) -> None:
    ran = dentine("phantom", "--out", str(tmp_path / "out"), *arguments)
    assert (ran.returncode, told in ran.stderr) == (2, True), ran.stderr
