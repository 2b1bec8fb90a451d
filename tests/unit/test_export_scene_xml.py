"""The scene's XML holds the same as the dictionary, and names its parameters."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from services.assets.mitsuba.scene import nested_scene
from services.assets.mitsuba.scene_xml import SceneParameter, write_scene
from services.core.geometry import Camera
from services.transport.optics.parameters import Medium, Tissue

CAMERA = Camera(
    name="c0",
    size=(8, 6),
    K=((100.0, 0.0, 4.0), (0.0, 100.0, 3.0), (0.0, 0.0, 1.0)),
    camera_from_world=((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 50.0), (0.0, 0.0, 0.0, 1.0)),
)


def written(tmp_path: Path) -> ET.Element:
    position = [SceneParameter(f"light_{axis}", value) for axis, value in zip("xyz", (1.0, 2.0, 3.0), strict=True)]
    tissue = Tissue(Medium(4.0, 0.99, 0.9, 0.8, -0.1), Medium(12.0, 0.98, g1=0.7))
    teeth = {"11": (Path("teeth/11/outer.ply"), Path("teeth/11/dentin.ply"))}
    scene = nested_scene(
        teeth, tissue, (CAMERA,), position, SceneParameter("intensity", 7.0), samples=SceneParameter("spp", 16)
    )
    write_scene(tmp_path / "scene.xml", scene)
    return ET.parse(tmp_path / "scene.xml").getroot()


def found(root: ET.Element, path: str) -> ET.Element:
    element = root.find(path)
    assert element is not None, path
    return element


def test_parameters_have_defaults_and_are_used(tmp_path: Path) -> None:
    root = written(tmp_path)
    assert {d.get("name"): d.get("value") for d in root.findall("default")} == {
        "light_x": "1.0", "light_y": "2.0", "light_z": "3.0", "intensity": "7.0", "spp": "16",
    }  # fmt: skip
    assert found(found(root, "emitter[@type='point']"), "point").attrib == {
        "name": "position",
        "x": "$light_x",
        "y": "$light_y",
        "z": "$light_z",
    }
    assert found(root, "sensor/sampler/integer").get("value") == "$spp"


def test_media_nest_by_reference(tmp_path: Path) -> None:
    root = written(tmp_path)
    shapes = {
        shape.get("id"): {r.get("name"): r.get("id") for r in shape.findall("ref")} for shape in root.findall("shape")
    }
    assert shapes == {
        "outer_11": {"interior": "medium_enamel"},
        "dentin_11": {"interior": "medium_dentin", "exterior": "medium_enamel"},
    }
    defined = [element.get("id") for element in root]
    assert defined.index("medium_enamel") < defined.index("outer_11")
    assert defined.index("medium_dentin") < defined.index("dentin_11")
    values = {v.get("name"): v.get("value") for v in root.findall("medium[@id='medium_enamel']/float")}
    assert values == {"sigma_t": "4.0", "albedo": "0.99"}


def test_the_pose_is_turned_to_mitsubas_axes(tmp_path: Path) -> None:
    matrix = found(written(tmp_path), "sensor/transform/matrix").attrib["value"]
    expected = np.linalg.inv(np.asarray(CAMERA.camera_from_world)) @ np.diag([-1, -1, 1, 1])
    np.testing.assert_allclose(np.array(matrix.split(), dtype=float).reshape(4, 4), expected)
