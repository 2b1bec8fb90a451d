"""Pictures of the teeth's outlines at a pose drawn over the photographs, and a page of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.calibrate.registration.contours import tooth_contours
from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.outlines import View
from services.calibrate.registration.pose import PoseStep, RigidPose
from services.core.geometry import Mesh
from services.core.pages.page import page_template
from services.core.raw.registration import Registration
from services.core.store import write_atomic

BRIGHT_PERCENT = 99.0
GAMMA = 2.2
COLOURS = {"landmarks": (255, 140, 0), "outlines": (80, 230, 80)}
"""Colour of the outlines after each step: blue, green, red, 0 to 255."""
CLICKED, PREDICTED = (60, 60, 230), (230, 60, 230)


def write_overlay(
    path: Path,
    view: View,
    teeth: Sequence[Mesh],
    occluders: Sequence[Mesh],
    steps: Sequence[PoseStep],
    clicks: Sequence[Click],
) -> None:
    """Write a PNG of the outlines after each step, the clicks as rings, and the clicks' positions predicted by the last
    step as dots, each joined to its click.
    """
    import cv2

    picture = displayed(view.image)
    for step in steps:
        contour, _ = tooth_contours(view.camera, _transformed(teeth, step.pose), _transformed(occluders, step.pose))
        column, row = np.floor(contour.pixels).astype(int).T
        picture[np.clip(row, 0, len(picture) - 1), np.clip(column, 0, picture.shape[1] - 1)] = COLOURS[step.name]
    for one in clicks if steps else ():
        if one.camera != view.camera.name:
            continue
        predicted = view.camera.project(steps[-1].pose.apply(one.point_mm[None]))[0][0]
        ends = [tuple(int(value) for value in np.round(place - 0.5)) for place in (one.pixel, predicted)]
        cv2.line(picture, ends[0], ends[1], PREDICTED, 1)
        cv2.circle(picture, ends[0], 4, CLICKED, 1)
        cv2.circle(picture, ends[1], 2, PREDICTED, -1)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, cv2.imencode(".png", picture)[1].tobytes())


def report_page(record: Registration) -> str:
    """Return an HTML page of the record and its pictures, which lie beside the page."""
    rows = [
        {
            "name": step.name,
            "points": step.points,
            "residual_mm": f"{step.residual_mm:.3f}",
            "residual_px": ", ".join(f"{name} {value:.2f}" for name, value in step.residual_px.items()),
            "errors": _errors(step.covariance),
            "left_out": "; ".join(step.left_out),
        }
        for step in record.steps
    ]
    template = page_template(Path(__file__).parent / "registration.html.j2")
    return template.render(
        teeth=", ".join(map(str, record.teeth)),
        repairs=record.repairs,
        warnings=record.warnings,
        misfit_mm=f"{record.misfit_mm:.3f}",
        rows=rows,
        pictures=record.pictures,
    )


def _errors(covariance: Sequence[Sequence[float]]) -> str:
    rotation_se, translation_se = np.split(np.sqrt(np.diag(np.asarray(covariance))), 2)
    return f"{np.degrees(np.linalg.norm(rotation_se)):.3f}°, {np.linalg.norm(translation_se):.3f} mm"


def _transformed(meshes: Sequence[Mesh], pose: RigidPose) -> list[Mesh]:
    return [Mesh(pose.apply(mesh.vertices_mm), mesh.faces) for mesh in meshes]


def displayed(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of linear radiance for display: blue, green and red from its first three channels, or
    grey where it has fewer, with a gamma of 2.2.
    """
    bright = max(float(np.percentile(image, BRIGHT_PERCENT)), 1e-12)
    shown = np.clip(image[..., :3] / bright, 0, 1) ** (1 / GAMMA)
    colours = shown[..., ::-1] if shown.shape[-1] == 3 else np.repeat(shown[..., :1], 3, axis=-1)
    return np.ascontiguousarray(np.round(255 * colours).astype(np.uint8))
