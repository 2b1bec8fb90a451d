"""Toy stages that leave a preparation and pictures, so that requests for them work as for a real job."""

from __future__ import annotations

import numpy as np

from services.api.masks.images import picture_of
from services.core.errors import CaptureInputError
from services.core.geometry import Camera, Light
from services.core.masks import digest_of, read_masks
from services.core.records import JobSpec
from services.core.results import AssetManifest, PreparedManifest
from services.core.stage import StageContext, StageEvent
from services.core.store import StageWriter, create_array
from tests.support import toy_stages
from tests.support.uploading import CAMERA

capture, export = toy_stages.capture, toy_stages.export
LIGHTS = tuple(Light(name=f"l{number}", position_mm=(0, 0, -50), intensity=(1.0,)) for number in range(2))


def prepare(_spec: JobSpec, context: StageContext) -> PreparedManifest:
    """Publish the validity bits of one camera and two lights; fail with an input error while ``bad-input`` exists."""
    if (context.root / "bad-input").exists():
        raise CaptureInputError("Frame c0_l3.npy is missing from the capture; copy it there.")
    camera = Camera.model_validate(CAMERA)
    writer = StageWriter(context.root, "prepared", context.attempt)
    shape = (1, len(LIGHTS), camera.size[1], camera.size[0])
    create_array(
        writer.folder / "prepared.zarr", "valid", shape, (1, 1, *shape[2:]), "uint16", ("camera", "light", "y", "x")
    )[:] = 1
    masks = digest_of(read_masks(context.root))
    made = {"masks": masks, "dentin_known": (), "valid_fraction": 0.0, "median_motion_px": None}
    record = PreparedManifest.model_validate(
        {"channels": ("green",), "cameras": (camera,), "lights": LIGHTS, "held_out": (), "fdi": ()} | made
    )
    writer.publish(record)
    return record


def fit(spec: JobSpec, context: StageContext) -> AssetManifest:
    """Report a preview picture, then run the toy fit."""
    path = "previews/0.png"
    (context.root / "previews").mkdir(exist_ok=True)
    (context.root / path).write_bytes(picture_of(np.zeros((6, 8), dtype=np.uint8)))
    shown = {
        "camera": "c0",
        "light": "l0",
        "channel": "green",
        "step": 0,
        "render": path,
        "photo": path,
        "residual": path,
    }
    context.report(StageEvent(stage="fit", kind="preview", data=shown))
    return toy_stages.fit(spec, context)
