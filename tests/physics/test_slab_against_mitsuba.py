"""Index-matched cells compared to stock Mitsuba.

Stock Mitsuba has a directional light but no narrow beam to which paths from a camera can be connected. In a cell much
wider than the paths of light, the two can be compared. Since shifting the beam shifts its image, the radiance under
irradiance 1 across the beam is the sum over pixels of the beam's image times the pixel area times the beam's cosine.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.transport.platform import prepare_device
from tests.support.small_slab import small_rig
from tests.support.z_scores import require_unbiased, student_to_normal

LIGHTS: list[dict[str, Any]] = [
    {"name": "l0", "side": "front", "angle_deg": 5.0},
    {"name": "l1", "side": "back", "angle_deg": 25.0},
]
CAMERAS: list[dict[str, Any]] = [
    {"name": f"{side}{angle}", "side": side, "angle_deg": float(angle)}
    for side in ("front", "back")
    for angle in (-20, 40)
]
HALF_WIDTH_MM = 200.0
BATCHES = 16


def direction(side: str, angle_deg: float, *, arriving: bool) -> np.ndarray:
    """Unit vector (3,) along the travel of light that arrives at a face or leaves it."""
    forward = (side == "front") == arriving
    return np.array(
        [math.sin(math.radians(angle_deg)), 0.0, math.cos(math.radians(angle_deg)) * (1 if forward else -1)]
    )


def by_mitsuba(sigma_s: float, g: float, sigma_a: float) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (lights * cameras,) under irradiance 1 across the beam, without unscattered light, and its standard
    errors, by stock Mitsuba.
    """
    prepare_device()
    import mitsuba as mi

    medium = {
        "type": "homogeneous",
        "sigma_t": sigma_s + sigma_a,
        "albedo": sigma_s / (sigma_s + sigma_a),
        "phase": {"type": "hg", "g": g},
    }
    # The cube reaches from -1 to 1 in its own frame.
    to_world = mi.ScalarTransform4f().translate([0, 0, 0.5]).scale([HALF_WIDTH_MM, HALF_WIDTH_MM, 0.5])
    means, errors = [], []
    for light in LIGHTS:
        for camera in CAMERAS:
            leaving = direction(camera["side"], camera["angle_deg"], arriving=False)
            face = np.array([0.0, 0.0, 0.0 if camera["side"] == "front" else 1.0])
            view = mi.ScalarTransform4f().look_at(
                origin=(face + 10 * leaving).tolist(), target=face.tolist(), up=[0, 1, 0]
            )
            scene = mi.load_dict(
                {
                    "type": "scene",
                    "integrator": {"type": "prbvolpath", "max_depth": 512, "rr_depth": 1000},
                    "cell": {"type": "cube", "to_world": to_world, "bsdf": {"type": "null"}, "interior": medium},
                    "light": {
                        "type": "directional",
                        "direction": direction(light["side"], light["angle_deg"], arriving=True).tolist(),
                        "irradiance": 1.0,
                    },
                    "sensor": {
                        "type": "orthographic",
                        "to_world": view @ mi.ScalarTransform4f().scale([0.01, 0.01, 1]),
                        "film": {
                            "type": "hdrfilm",
                            "width": 1,
                            "height": 1,
                            "rfilter": {"type": "box"},
                            "pixel_format": "luminance",
                        },
                    },
                },
                optimize=False,
            )
            batches = [float(np.array(mi.render(scene, spp=2**15, seed=seed)).ravel()[0]) for seed in range(BATCHES)]
            means.append(np.mean(batches))
            errors.append(np.std(batches, ddof=1) / math.sqrt(BATCHES))
    return np.array(means), np.array(errors)


@pytest.mark.slow
@pytest.mark.parametrize(("sigma_s", "g", "sigma_a"), [(1.0, 0.6, 0.1), (3.0, -0.2, 0.05), (0.5, 0.0, 0.5)])
def test_matched_cells_agree_with_stock_mitsuba(sigma_s: float, g: float, sigma_a: float) -> None:
    pixels = {"x_mm": [-HALF_WIDTH_MM, HALF_WIDTH_MM], "y_mm": [-HALF_WIDTH_MM, HALF_WIDTH_MM], "columns": 2, "rows": 2}
    rig = small_rig(
        cell={"width_mm": 1.0, "index": None, "boundary": "matched"}, pixels=pixels, lights=LIGHTS, cameras=CAMERAS
    )
    images = render(
        rig, henyey_greenstein(sigma_s, g, sigma_a), seed=3, step=0, batches=BATCHES, paths=16000, scores=False
    ).images
    slants = np.repeat([math.cos(math.radians(light["angle_deg"])) for light in LIGHTS], len(CAMERAS))
    ours = images.sum(axis=-1) * rig.grid.area_mm2 * slants
    truth, truth_error = by_mitsuba(sigma_s, g, sigma_a)
    error = np.hypot(ours.std(axis=0, ddof=1) / math.sqrt(BATCHES), truth_error)
    # The tolerance is 2 %; the joint standard error is at most a third of it.
    assert (error <= 0.02 / 3 * truth).all()
    require_unbiased(student_to_normal((ours.mean(axis=0) - truth) / error, BATCHES), independent=len(truth))
