"""The first picture of a jaw's report: teeth, gums and the wall, against stock Mitsuba's mouth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from services.assets.asset import middle_of
from services.assets.colour import beside as beside_module
from services.assets.colour.beside import Shown, beside
from services.assets.colour.seen import Surfaces, seen
from services.assets.content import RGB
from services.assets.mitsuba.scene import load_scene
from services.core.geometry import Light, Tooth
from services.core.records import JobSpec
from services.core.results import Estimate, FitReport, PreparedManifest, ToothReport
from services.core.store import StageWriter, StoredArray, create_array
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium
from services.transport.platform import prepare_device
from tests.support.small_mouth import CORE, FREE, LIGHTS_MM, MOUTH, ROOTED, gums, stock_mouth, wall
from tests.support.small_tooth import INTENSITY, camera_at

CAMERA = camera_at((0.2, 1.0, 0.3), size=16, span_mm=16.0)
TEETH = (Tooth(11, ROOTED, CORE), Tooth(12, FREE))
LIGHTS = (Light(name="l0", position_mm=tuple(LIGHTS_MM[0].tolist()), intensity=(INTENSITY,) * 3),)
SHOWN = Shown(TEETH, (CAMERA,), LIGHTS, middle_of(TEETH), gums(), wall())


def table(prefix: str, medium: Medium) -> dict[str, Estimate]:
    values = {f"{prefix}.{name}": float(getattr(medium, name)) for name in MEDIUM_FIELDS}
    return {name: Estimate(value=value, se=0.01, unit="1", determined=True) for name, value in values.items()}


def report() -> FitReport:
    """The mouth's optics as a jaw's report; the teeth are not in the order of the scan."""
    rooted, free = MOUTH.teeth
    assert MOUTH.gums is not None
    wall_of = {"cavity.reflectance": Estimate(value=MOUTH.reflectance or 0.0, se=0.01, unit="1", determined=True)}
    errors = dict.fromkeys(RGB, 0.03)

    def tooth(parameters: dict[str, Estimate]) -> ToothReport:
        return ToothReport(
            state="fitted", sentence="", pixels=9, parameters=dict.fromkeys(RGB, parameters), fit_error=errors,
            held_out_error=errors,
        )  # fmt: skip

    return FitReport(
        converged=True, advice="", parameters=dict.fromkeys(RGB, table("gums", MOUTH.gums) | wall_of),
        teeth={
            "12": tooth(table("enamel", free.enamel)),
            "11": tooth(table("enamel", rooted.enamel) | table("dentin", rooted.dentin)),
        },
        fit_error=errors, held_out_error=errors, fit_error_se=errors, steps=1, seconds=1.0,
    )  # fmt: skip


def test_pixels_are_told_apart_by_what_they_show() -> None:
    found = seen(CAMERA, Surfaces(TEETH, gums(), wall()))
    assert set(np.unique(found.part[found.covered > 0])) == {0, 1, 2}
    assert (found.teeth <= found.covered).all()
    assert found.teeth[found.part > 0].max() <= 0.5
    assert found.covered.max() == pytest.approx(1.0)
    # A filter of one part alone is given neither light nor surface of the others.
    image = np.where(found.part[..., None] == 1, 5.0, 1.0) * found.covered[..., None]
    given: list[tuple[np.ndarray, np.ndarray]] = []

    def kept(own: np.ndarray, cover: np.ndarray) -> np.ndarray:
        given.append((own, cover))
        return own

    np.testing.assert_allclose(found.by_part(kept, image), image)
    for own, cover in given:
        assert not own[cover == 0].any()


@pytest.mark.dear("the engine and stock Mitsuba each compile a mouth")
def test_a_jaw_looks_like_stock_mitsubas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside_module, "PATHS", 30_000)
    prepare_device()
    import mitsuba as mi

    scene = load_scene(stock_mouth(tmp_path / "stock", CAMERA, 0, "matched", 256))
    photograph = np.array(mi.render(scene, spp=256, seed=3), dtype=np.float32)[..., :1].repeat(3, axis=-1)
    writer = StageWriter(tmp_path, "prepared", 1)
    shape, axes = (1, 1, *photograph.shape), ("camera", "light", "y", "x", "channel")
    create_array(writer.folder / "prepared.zarr", "radiance", shape, shape, "float32", axes)[0, 0] = photograph
    manifest = PreparedManifest(
        channels=RGB, cameras=(CAMERA,), lights=LIGHTS, held_out=(), fdi=(11, 12), dentin_known=(11,),
        median_motion_px=None, valid_fraction=1.0,
    )  # fmt: skip
    writer.publish(manifest)
    radiance = StoredArray(tmp_path / "prepared" / "prepared.zarr" / "radiance")
    spec = JobSpec(capture=tmp_path, kind="jaw", boundary="matched")
    found = beside(spec, report(), manifest, radiance, SHOWN)
    assert found is not None
    (pair,) = found.pairs
    times = pair.render.shape[0] // pair.photo.shape[0]
    render = beside_module.square_means(pair.render, times)
    assert pair.compared.sum() > 5
    # Nine pixels that teeth fill, at 256 paths of stock Mitsuba that scatter by their own value: 2 % of the mean, as
    # much for the engine's paths; the edges of part and filter, 3 %.
    assert render[pair.compared].mean() == pytest.approx(pair.photo[pair.compared].mean(), rel=0.1)
    # Gums and the wall are rendered too, each at the photograph's brightness.
    part = seen(CAMERA, SHOWN.surfaces).part
    assert set(np.unique(part)) == {0, 1, 2}
    assert render.mean() == pytest.approx(pair.photo.mean(), rel=0.1)
