"""What exported files say of a rough surface: roughness as each program names it, and its index."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from services.assets.exporters import export_to
from services.core.results import AssetManifest
from services.core.store import StageWriter
from services.transport.optics.parameters import Medium, Tissue
from tests.support.cycles_scenes import IOR, Case, ball, write_case
from tests.support.small_tooth import camera_at
from tests.unit.test_blender_bodies import READER
from tests.unit.test_usd_export import prim, value

MILK = Tissue(Medium(2.5, 0.99, 1.0, 0.6), Medium(5.0, 0.98, 1.0, 0.6))
ALPHA = 0.3


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job's folder with the asset of a ball whose rough surface has alpha 0.3."""
    root = tmp_path_factory.mktemp("job")
    writer = StageWriter(root, "asset", 1)
    view = camera_at((0.3, 1.0, 0.2), size=16, span_mm=7.0)
    write_case(writer.folder, Case(ball(3.0, 2), ball(2.4, 2), (MILK,) * 3, view, boundary="rough", roughness=ALPHA))
    writer.publish(AssetManifest(files=()))
    return root


def test_gltf_and_usd_name_the_root_of_alpha(job: Path) -> None:
    gltf, usd = export_to(job, ("gltf", "usd"))
    (enamel, _) = json.loads((gltf / "asset.gltf").read_text())["materials"]
    assert enamel["pbrMetallicRoughness"]["roughnessFactor"] == pytest.approx(ALPHA**0.5)
    assert enamel["extensions"]["KHR_materials_ior"]["ior"] == IOR
    material = prim((usd / "asset.usda").read_text(), "Material", "tooth_11_enamel")
    told = [value(material, f"inputs:{name}") for name in ("roughness", "specular_roughness", "ior", "specular_ior")]
    # Nine digits are written.
    np.testing.assert_allclose(told, [ALPHA**0.5, ALPHA**0.5, IOR, IOR], rtol=1e-8)


def test_blender_has_glass_of_the_same_facets(job: Path) -> None:
    (folder,) = export_to(job, ("blender",))
    asset = READER.Asset(folder)
    surface, roughness, distribution = asset.finish("asset", None)
    assert (surface, distribution) == ("glass", "GGX")
    assert roughness == pytest.approx(ALPHA**0.5)
    # What the user asks for goes before the asset.
    assert asset.finish("asset", 0.2)[1] == 0.2
    assert asset.finish("glass", None) == ("glass", 0.0, "GGX")
    asset.rig["multiple_scattering"] = True
    assert asset.finish("asset", None)[2] == "MULTI_GGX"
    asset.rig["boundary"] = "thin"
    assert asset.finish("asset", None) == ("asset", 0.0, "GGX")
    # Light is bent where enamel meets air, and nowhere else.
    assert {(side.ior, side.outside) for body in asset.bodies() for side in body.sides} == {(IOR, True), (1.0, False)}
