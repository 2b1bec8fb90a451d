"""A small job whose photographs stock Mitsuba rendered from its own asset, in red, green and blue."""

from __future__ import annotations

import json
import runpy
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from services.assets.asset import write_asset
from services.assets.colour.develop import CapturedColours
from services.assets.content import RGB
from services.core.calibration.cameras_and_lights import CameraColour
from services.core.geometry import Light, Mesh, Tooth
from services.core.results import AssetManifest, Estimate, FitReport, PreparedManifest
from services.core.store import StageWriter, create_array
from services.phantom.files import XYZ_FROM_CAMERA
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from tests.support.prepared import camera, sphere

MEDIA = {
    channel: Tissue(Medium(0.5, albedo, g1=0.3), Medium(1.0, albedo, g1=0.3))
    for channel, albedo in zip(RGB, (0.95, 0.9, 0.7), strict=True)
}
"""Thin media, whose paths are short."""
LIGHTS = (
    Light(name="l0", position_mm=(900.0, 0.0, 400.0), intensity=(1e6, 9e5, 2e6)),
    Light(name="l1", position_mm=(300.0, 300.0, -700.0), intensity=(1e6, 2e6, 5e5)),
)
COLOURS = {"c0": CameraColour(xyz_from_rgb=XYZ_FROM_CAMERA)}


def report(channels: tuple[str, ...] = RGB, media: Mapping[str, Tissue] = MEDIA) -> FitReport:
    def table(tissue: Tissue) -> dict[str, Estimate]:
        found = {}
        for part in ("enamel", "dentin"):
            medium = tissue.medium(part)
            values = {leaf: float(getattr(medium, leaf)) for leaf in MEDIUM_FIELDS}
            values["sigma_s_reduced"] = medium.sigma_s_reduced
            for leaf, value in values.items():
                found[f"{part}.{leaf}"] = Estimate(value=value, se=0.01 * value, unit="1", determined=True)
        return found

    errors = dict.fromkeys(channels, 0.03)
    return FitReport(
        converged=True, advice="", parameters={channel: table(media[channel]) for channel in channels},
        fit_error=errors, held_out_error=errors, fit_error_se=errors, held_out_error_se=errors, steps=1, shape=(),
        seconds=1.0,
    )  # fmt: skip


def write_job(
    root: Path, samples: int, channels: tuple[str, ...] = RGB, held_out: tuple[tuple[str, str], ...] = (("c0", "l1"),)
) -> Path:
    """Publish ``asset`` and ``prepared`` below ``root``, with photographs of so many paths per pixel."""
    ball = sphere(4.0)
    tooth, one = Tooth(11, ball, Mesh(0.8 * ball.vertices_mm, ball.faces)), camera("c0")
    lights = tuple(light.model_copy(update={"intensity": light.intensity[: len(channels)]}) for light in LIGHTS)
    colours = CapturedColours(channels, COLOURS) if channels == RGB else None
    asset = StageWriter(root, "asset", 1)
    files = write_asset(
        asset.folder, report(channels), (tooth,), (one,), lights, channels=channels, boundary="matched", ior=1.631,
        colours=colours,
    )  # fmt: skip
    asset.publish(AssetManifest(files=files, held_out_error=0.03))
    render = runpy.run_path(str(root / "asset" / "render.py"))["render"]
    prepared = StageWriter(root, "prepared", 1)
    width, height = one.size
    shape = (1, len(lights), height, width, len(channels))
    axes = ("camera", "light", "y", "x", "channel")
    radiance = create_array(prepared.folder / "prepared.zarr", "radiance", shape, (1, 1, *shape[2:]), "float32", axes)
    for k, light in enumerate(lights):
        radiance[0, k] = render(root / "asset", "c0", light.name, samples, seed=17).astype(np.float32)
    prepared.publish(
        PreparedManifest(
            channels=channels,
            cameras=(one,),
            lights=lights,
            held_out=held_out,
            fdi=(11,),
            dentin_known=(11,),
            median_motion_px=None,
            valid_fraction=1.0,
            colour=COLOURS if colours else None,
        )
    )
    (root / "phantom").mkdir()
    truth = {
        channel: {
            part: {"sigma_s_reduced": MEDIA[channel].medium(part).sigma_s_reduced} for part in ("enamel", "dentin")
        }
        for channel in channels
    }
    (root / "phantom" / "truth.json").write_text(json.dumps({"channels": truth}))
    (root / "parameters.json").write_bytes((root / "asset" / "parameters.json").read_bytes())
    return root
