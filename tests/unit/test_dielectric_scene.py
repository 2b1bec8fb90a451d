"""An asset of a thin boundary as a dielectric, for Mitsuba in a shell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.assets.asset import write_asset
from services.assets.mitsuba.dielectric import ABSORPTION, DIELECTRIC_SCENE, as_dielectric
from services.assets.mitsuba.scene import medium_dict
from services.core.geometry import Mesh, Tooth
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.colour_job import LIGHTS, report
from tests.support.mitsuba_variants import variant
from tests.support.prepared import camera, sphere


def test_absorption_falls_and_scattering_stays() -> None:
    scene = as_dielectric({"type": "scene", "medium_enamel": medium_dict(Medium(4.0, 0.9, g1=0.5))})
    medium = scene["medium_enamel"]
    assert medium["sigma_t"] * medium["albedo"] == pytest.approx(3.6)
    assert medium["sigma_t"] * (1 - medium["albedo"]) == pytest.approx(0.4 * ABSORPTION)
    assert medium["phase"] == {"type": "hg", "g": 0.5}


def test_a_white_body_in_a_white_sky_is_white(tmp_path: Path) -> None:
    ball = sphere(4.0)
    tooth = Tooth(11, ball, Mesh(0.8 * ball.vertices_mm, ball.faces))
    white = Tissue(Medium(0.5, 1.0, g1=0.3), Medium(1.0, 1.0, g1=0.3))
    media = dict.fromkeys(("red", "green", "blue"), white)
    files = write_asset(
        tmp_path, report(media=media), (tooth,), (camera("c0"),), LIGHTS, channels=tuple(media), boundary="thin",
        ior=1.631,
    )  # fmt: skip
    assert DIELECTRIC_SCENE in files
    assert "scene.xml" not in files
    prepare_device()
    import mitsuba as mi

    with variant("llvm_ad_rgb"):
        scene = mi.load_file(str(tmp_path / DIELECTRIC_SCENE), optimize=False, width_0=10, height_0=12)
        image = np.array(mi.render(scene, spp=64, integrator=mi.load_dict({"type": "prbvolpath", "max_depth": 500})))
    # Whatever leaves came from the sky of radiance 1; a rough surface without multiple scattering loses up to 2 % at
    # each passage (Walter et al. 2007), and the lost is what other passages would have had. 7,680 paths of weight
    # near 1 have a standard error of some 0.2 %.
    assert image.mean() == pytest.approx(1.0, abs=0.04)
