"""Colours of an asset: matrices against published ones and colour-science, and what a white plate looks like when stock
Mitsuba renders it and the asset's own script develops it.
"""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.asset import SHIPPED
from services.assets.colour.develop import CapturedColours, developed, diffuser_radiance, rig_colours
from services.assets.colour.spaces import ACESCG, BRADFORD, LINEAR_SRGB, ColourSpace, adaptation
from services.assets.content import RGB
from services.core.calibration.cameras_and_lights import CameraColour
from services.core.calibration.colours import colours_among, require_colours, xyz_of
from services.core.calibration.record import Calibration, recalibrated, require_consistent
from services.core.colour.cie import D50
from services.core.errors import CaptureInputError
from services.core.geometry import Light
from services.core.records import FolderCapture
from tests.support.prepared import camera

D65 = np.array([0.95047, 1.0, 1.08883])
"""XYZ of illuminant D65 (ASTM E308-01)."""
SRGB_FROM_D65 = [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560],
                 [0.0556434, -0.2040259, 1.0572252]]  # fmt: skip
SRGB_FROM_D50 = [[3.1338561, -1.6168667, -0.4906146], [-0.9787684, 1.9161415, 0.0334540],
                 [0.0719453, -0.2289914, 1.4052427]]  # fmt: skip
"""B. Lindbloom, "RGB/XYZ Matrices", sRGB for D65 and adapted to D50 by Bradford."""
AP1_FROM_XYZ = [[1.6410233797, -0.3248032942, -0.2364246952], [-0.6636628587, 1.6153315917, 0.0167563477],
                [0.0117218943, -0.0082844420, 0.9883948585]]  # fmt: skip
"""Academy S-2014-004, section 4.3."""
MATRIX = ((0.62, 0.22, 0.12422), (0.28, 0.70, 0.02), (0.03, 0.12, 0.67521))
"""A camera's XYZ under D50 from red, green and blue; its rows add up to D50."""
ROOTS = ((0.6, 0.2, 0.1, 0.02, 0.02, 0.02422), (0.3, 0.6, 0.02, 0.04, 0.02, 0.02), (0.0, 0.1, 0.65, 0.0, 0.05, 0.02521))
LIGHT = Light(name="l0", position_mm=(300.0, 300.0, -700.0), intensity=(1e6, 2e6, 5e5))


@pytest.mark.parametrize(
    ("space", "white", "published"),
    [
        # Published values of sRGB start from a white of four digits, which moves a matrix by 1 in the fourth digit.
        (LINEAR_SRGB, D65, (SRGB_FROM_D65, 5e-4)),
        (LINEAR_SRGB, D50, (SRGB_FROM_D50, 8e-4)),
        (ACESCG, None, (AP1_FROM_XYZ, 1e-9)),
    ],
)
def test_matrices_are_the_published_ones(
    space: ColourSpace, white: np.ndarray | None, published: tuple[list[list[float]], float]
) -> None:
    found = np.linalg.inv(space.xyz_from_rgb()) if white is None else space.rgb_from_xyz(white)
    np.testing.assert_allclose(found, published[0], atol=published[1])


def test_a_grey_patch_under_d65_is_grey_in_both_spaces() -> None:
    grey = 0.18 * D65
    for space in (LINEAR_SRGB, ACESCG):
        np.testing.assert_allclose(space.rgb_from_xyz(D65) @ grey, [0.18] * 3, rtol=1e-12)
        np.testing.assert_allclose(space.rgb_from_xyz() @ adaptation(D65, D50) @ grey, [0.18] * 3, rtol=1e-12)


@pytest.mark.parametrize(("space", "theirs"), [(LINEAR_SRGB, "sRGB"), (ACESCG, "ACEScg")])
def test_colours_are_those_of_colour_science(space: ColourSpace, theirs: str) -> None:
    colour = pytest.importorskip("colour", reason="colour-science is not installed", exc_type=ImportError)
    xyz = np.random.default_rng(0).uniform(0.0, 1.0, (100, 3))
    other = colour.RGB_COLOURSPACES[theirs]
    np.testing.assert_allclose(BRADFORD, colour.adaptation.CHROMATIC_ADAPTATION_TRANSFORMS["Bradford"])
    np.testing.assert_allclose(space.primaries, other.primaries)
    np.testing.assert_allclose(space.white, other.whitepoint)
    white = colour.XYZ_to_xy(D50)
    # sRGB's standard states its matrix to four digits, and colour-science takes that.
    found = colour.XYZ_to_RGB(xyz, other, white, chromatic_adaptation_transform="Bradford")
    np.testing.assert_allclose(xyz @ space.rgb_from_xyz().T, found, atol=5e-4)


def test_a_colour_goes_to_a_space_and_back() -> None:
    rgb = np.random.default_rng(1).uniform(0.0, 1.0, (50, 3))
    own = CameraColour(xyz_from_rgb=MATRIX)
    for space in (LINEAR_SRGB, ACESCG):
        there = developed(rgb, own, space)
        back = there @ np.linalg.inv(space.rgb_from_xyz()).T @ np.linalg.inv(np.array(MATRIX)).T
        np.testing.assert_allclose(back, rgb, atol=1e-12)
    np.testing.assert_allclose(developed(rgb, None, LINEAR_SRGB), rgb, atol=1e-12)


def plate(white: float) -> np.ndarray:
    """Radiance (1, 1, 3) of a diffuse plate that faces the light, of ``white`` reflectance, by stock Mitsuba."""
    from services.transport.platform import prepare_device

    prepare_device()
    import mitsuba as mi

    towards = np.array(LIGHT.position_mm)
    eye = towards / np.linalg.norm(towards) * 100 + [1.0, 2.0, 0.0]
    planes = []
    for intensity in LIGHT.intensity:
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "direct"},
            "plate": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], towards.tolist(), [0, 0, 1]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": white}},
            },
            "light": {"type": "point", "position": towards.tolist(), "intensity": {"type": "rgb", "value": intensity}},
            "sensor": {
                "type": "perspective", "fov": 0.01, "film": {"type": "hdrfilm", "width": 1, "height": 1},
                "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), [0, 0, 0], [0, 0, 1]),
            },
        }  # fmt: skip
        planes.append(np.array(mi.render(mi.load_dict(scene), spp=4))[..., 0])
    return np.stack(planes, axis=-1)


@pytest.mark.parametrize("roots", [None, ROOTS])
def test_a_white_plate_that_stock_mitsuba_renders_is_white(tmp_path: Path, roots: Any) -> None:
    own = CameraColour(xyz_from_rgb=MATRIX, root_polynomial=roots)
    told = rig_colours(CapturedColours(RGB, {"c0": own}), RGB, ("c0",), (0.0, 0.0, 0.0))
    rig = {"channels": RGB, "colour": told, "lights": {"l0": LIGHT.model_dump(exclude={"name"})}}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    script = runpy.run_path(str(SHIPPED / "render.py"))
    for white in (1.0, 0.4):
        radiance = plate(white)
        for name, space in (("srgb", LINEAR_SRGB), ("acescg", ACESCG)):
            # Mitsuba computes in single precision.
            found = script["develop"](radiance, tmp_path, "c0", "l0", name)
            np.testing.assert_allclose(found, np.full((1, 1, 3), white), rtol=1e-5)
            relative = radiance / diffuser_radiance(LIGHT, (0.0, 0.0, 0.0))
            np.testing.assert_allclose(found, developed(relative, own, space), rtol=1e-6)


def test_channels_are_found_by_name_whatever_their_order(tmp_path: Path) -> None:
    told = rig_colours(
        CapturedColours(RGB, {"c0": CameraColour(xyz_from_rgb=MATRIX)}), ("blue", "red", "green"), ("c0",), (0, 0, 0)
    )
    light = LIGHT.model_dump(exclude={"name"})
    image = np.array([0.2, 0.5, 0.9])
    found = []
    for channels, order in ((RGB, (0, 1, 2)), (("blue", "red", "green"), (2, 0, 1))):
        lamp = light | {"intensity": [light["intensity"][k] for k in order]}
        (tmp_path / "rig.json").write_text(json.dumps({"channels": channels, "colour": told, "lights": {"l0": lamp}}))
        develop = runpy.run_path(str(SHIPPED / "render.py"))["develop"]
        found.append(develop(image[list(order)], tmp_path, "c0", "l0", "srgb"))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
    assert rig_colours(CapturedColours(), ("red", "green"), ("c0",), (0.0, 0.0, 0.0)) is None


def calibration(**changes: Any) -> Calibration:
    fields: dict[str, Any] = {"units": "mm", "channels": RGB, "cameras": (camera("c0"),), "lights": (LIGHT,)}
    fields |= changes
    for name in ("cameras", "lights"):
        fields[name] = [one.model_dump() for one in fields[name]]
    return Calibration.model_validate(fields)


def test_a_capture_takes_the_colours_of_its_calibration() -> None:
    own, other = CameraColour(xyz_from_rgb=MATRIX), CameraColour(xyz_from_rgb=(MATRIX[2], MATRIX[1], MATRIX[0]))
    capture = FolderCapture(units="mm", channels=RGB, cameras=(camera("c0"),), lights=(LIGHT,))
    assert "colour" not in capture.model_dump()
    both = calibration(cameras=(camera("c0"), camera("c1")), colour={"c0": own, "c1": other})
    assert recalibrated(capture, both, Path("x")).colour == {"c0": own}
    assert recalibrated(capture, calibration(), Path("x")).colour is None
    assert colours_among({"c1": other}, ("c0",)) is None
    np.testing.assert_allclose(xyz_of(np.ones(3), own), D50)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"colour": {"c7": CameraColour(xyz_from_rgb=MATRIX)}}, "camera c7, which is not among its cameras; remove"),
        (
            {
                "colour": {"c0": CameraColour(xyz_from_rgb=MATRIX)},
                "channels": ("green",),
                "lights": (LIGHT.model_copy(update={"intensity": (1.0,)}),),
            },
            "its channels are 1; leave the colour out",
        ),
        ({"colour": {"c0": CameraColour(xyz_from_rgb=MATRIX, root_polynomial=((1.0,),) * 3)}}, "three rows of six"),
        ({"colour": {"c0": CameraColour(xyz_from_rgb=(MATRIX[0],) * 3)}}, "matrix cannot be inverted; calibrate again"),
    ],
)
def test_impossible_colours_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(CaptureInputError, match=sentence):
        require_consistent(calibration(**changes), "Calibration x.json")


def test_a_capture_without_colours_may_have_any_channels() -> None:
    require_colours(None, ("c0",), 1, "x")
    require_consistent(calibration(), "Calibration x.json")
