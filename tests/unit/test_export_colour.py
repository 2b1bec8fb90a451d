"""The colour scene of an asset: red, green and blue in one, exact where phase functions are equal, and rendered by the
``mitsuba`` command.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.asset import write_asset
from services.assets.content import RGB
from services.assets.mitsuba.rgb import Colour, colour_scene
from services.assets.mitsuba.scene import MIN_FILM_PIXELS, nested_scene
from services.core.errors import InputError
from services.core.geometry import Light, Mesh, Tooth
from services.core.results import Estimate, FitReport
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from tests.support.prepared import camera, sphere

MITSUBA = Path(sys.executable).parent / "mitsuba"
LIGHT = Light(name="l0", position_mm=(300.0, 300.0, -700.0), intensity=(1e6, 2e6, 5e5))
EQUAL = tuple(
    Tissue(Medium(s, a, 0.9, 0.6, -0.1), Medium(2 * s, a, g1=0.5)) for s, a in ((2.0, 0.99), (3.0, 0.97), (4.0, 0.9))
)
OTHER = tuple(Tissue(Medium(3.0, 0.97, 0.9, g, -0.1), Medium(6.0, 0.95, g1=g)) for g in (0.5, 0.6, 0.8))


def scenes(tissues: tuple[Tissue, ...]) -> list[dict[str, Any]]:
    files = {"11": (Path("outer.ply"), Path("dentin.ply"))}
    return [
        nested_scene(files, tissue, (camera("c0"),), LIGHT.position_mm, intensity)
        for tissue, intensity in zip(tissues, LIGHT.intensity, strict=True)
    ]


def reduced(medium: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Reduced scattering and absorption of a colour medium, per mm, by channel."""
    extinction, albedo = medium["scale"] * np.array(medium["sigma_t"].values), np.array(medium["albedo"].values)
    phase = medium["phase"]
    g = (
        phase["g"]
        if phase["type"] == "hg"
        else ((1 - phase["weight"]) * phase["first"]["g"] + phase["weight"] * phase["second"]["g"])
    )
    return extinction * albedo * (1 - g), extinction * (1 - albedo)


@pytest.mark.parametrize(("tissues", "is_exact"), [(EQUAL, True), (OTHER, False)])
def test_every_channel_keeps_its_reduced_scattering_and_absorption(tissues: tuple[Tissue, ...], is_exact: bool) -> None:
    found = colour_scene(scenes(tissues))
    assert found.is_exact == is_exact
    for part in ("enamel", "dentin"):
        media = [getattr(tissue, part) for tissue in tissues]
        scattering, absorption = reduced(found.scene[f"medium_{part}"])
        np.testing.assert_allclose(scattering, [one.sigma_s_reduced for one in media])
        np.testing.assert_allclose(absorption, [(1 - one.alpha) * one.sigma for one in media])
        assert max(found.scene[f"medium_{part}"]["sigma_t"].values) == 1
    assert found.scene["light"]["intensity"] == Colour((1e6, 2e6, 5e5))


def test_scenes_that_differ_by_more_than_numbers_are_refused() -> None:
    red, green, blue = scenes(EQUAL)
    green["outer_11"] = green["outer_11"] | {"filename": "other.ply"}
    with pytest.raises(InputError, match="cannot be one scene in colour"):
        colour_scene([red, green, blue])


def asset(folder: Path, tissues: tuple[Tissue, ...], channels: tuple[str, ...]) -> None:
    """An asset of a small sphere in a sphere."""

    def table(tissue: Tissue) -> dict[str, Estimate]:
        return {
            f"{part}.{leaf}": Estimate(value=getattr(getattr(tissue, part), leaf), se=0.01, unit="1", determined=True)
            for part in ("enamel", "dentin")
            for leaf in MEDIUM_FIELDS
        }

    errors = dict.fromkeys(channels, 0.03)
    report = FitReport(
        converged=True, advice="", parameters={c: table(t) for c, t in zip(channels, tissues, strict=True)},
        fit_error=errors, held_out_error=errors, fit_error_se=errors, held_out_error_se=errors, steps=1, shape=(),
        seconds=1.0,
    )  # fmt: skip
    ball = sphere(4.0)
    tooth = Tooth(11, ball, Mesh(0.8 * ball.vertices_mm, ball.faces))
    light = LIGHT.model_copy(update={"intensity": LIGHT.intensity[: len(channels)]})
    write_asset(folder, report, (tooth,), (camera("c0"),), (light,), channels=channels, boundary="matched", ior=1.631)


def rendered(scene: Path, variant: str, out: Path) -> np.ndarray:
    """Image of the ``mitsuba`` command, (H, W, C)."""

    size = ["-D", "width_0=8", "-D", "height_0=8", "-D", "spp=4096"]
    command = [str(MITSUBA), "-m", variant, *size, "-o", str(out), str(scene)]
    subprocess.run(command, capture_output=True, check=True, timeout=120)
    import OpenEXR

    with OpenEXR.File(str(out), separate_channels=True) as file:
        planes = file.channels()
        names = ["R", "G", "B"] if "R" in planes else ["Y"]
        return np.stack([planes[name].pixels for name in names], axis=-1)


def test_the_mitsuba_command_shows_each_channel_as_its_own_scene(tmp_path: Path) -> None:
    asset(tmp_path, EQUAL, RGB)
    rig = json.loads((tmp_path / "rig.json").read_text())
    assert rig["scene.xml"] == "rgb"
    colour = rendered(tmp_path / "scene.xml", "llvm_ad_rgb", tmp_path / "colour.exr")
    for k, name in enumerate(RGB):
        grey = rendered(tmp_path / f"scene_{name}.xml", "llvm_ad_mono", tmp_path / f"{name}.exr")
        # Means of four times the paths differ by 0.2 %, so one standard error is at most 0.4 %; four of them.
        assert colour[..., k].mean() == pytest.approx(grey.mean(), rel=0.016)


def test_an_asset_of_other_channels_has_its_first_as_the_shells_scene(tmp_path: Path) -> None:
    asset(tmp_path, EQUAL[:1], ("green",))
    assert json.loads((tmp_path / "rig.json").read_text())["scene.xml"] == "green"
    assert (tmp_path / "scene.xml").read_text() == (tmp_path / "scene_green.xml").read_text()
    sizes = re.findall('<default name="(?:width|height)_0" value="([0-9]+)"', (tmp_path / "scene.xml").read_text())
    assert MIN_FILM_PIXELS <= max(map(int, sizes)) < 2 * MIN_FILM_PIXELS
