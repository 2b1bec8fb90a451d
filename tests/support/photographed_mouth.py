"""Input of a registration: a phantom jaw drawn with plain shading for three cameras, and clicks on its landmarks.

The drawing uses the registration's z-buffer but neither its outlines nor its search. Teeth are off-white with a dark
line where they meet, gums are red, lips of another red hide a part, and every pixel has noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.jaw import Jaw
from services.anatomy.visibility import visible_surfaces
from services.calibrate.registration.landmarks import Click
from services.calibrate.registration.outlines import View
from services.calibrate.registration.pose import RigidPose
from services.core.geometry import Camera, Mesh
from services.phantom.dome_rig import dome_cameras
from tests.support.phantom_bodies import phantom_jaw

TOOTH, GUMS, LIP, DARK = (0.80, 0.72, 0.58), (0.55, 0.25, 0.24), (0.45, 0.28, 0.27), (0.03, 0.02, 0.02)
FINER = 2
"""Number of samples per pixel along each axis; their mean is the pixel's value."""
NOISE = 0.01


@dataclass(frozen=True)
class Mouth:
    """A jaw, its photographs, and its true pose."""

    teeth: tuple[Mesh, ...]
    """Outer surfaces in the scan's frame."""
    gums: Mesh
    fdi: tuple[int, ...]
    centre_mm: NDArray[np.float64]
    cameras: dict[str, Camera]
    views: tuple[View, ...]
    rig_from_scan: RigidPose


def photographed_mouth(subject: int | None, seed: int, pixel_mm: float = 0.15, jaw: Jaw | None = None) -> Mouth:
    """Draw a subject's jaw as three cameras of the dome see it, and move its meshes to a scan frame of random pose."""
    rng = np.random.default_rng(seed)
    jaw = phantom_jaw(subject) if jaw is None else jaw
    outers = tuple(tooth.outer for tooth in jaw.teeth)
    # The rig's frame is that of the jaw; the scan's frame is random.
    away = RigidPose(np.eye(3), np.zeros(3)).moved(
        np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-30, 30, 3)]), np.zeros(3)
    )
    cameras = {camera.name: camera for camera in dome_cameras(3, pixel_mm, (*outers,))}
    cameras = {name: _with_margin(camera, round(4 / pixel_mm)) for name, camera in cameras.items()}
    views = tuple(View(camera, drawn(camera, outers, jaw.gums, rng)) for camera in cameras.values())
    inverse = RigidPose(away.rotation.T, -away.rotation.T @ away.translation_mm)
    teeth = tuple(Mesh(away.apply(mesh.vertices_mm), mesh.faces) for mesh in outers)
    gums = Mesh(away.apply(jaw.gums.vertices_mm), jaw.gums.faces)
    centre = np.concatenate([mesh.vertices_mm for mesh in teeth]).mean(axis=0)
    return Mouth(teeth, gums, tuple(tooth.fdi for tooth in jaw.teeth), centre, cameras, views, inverse)


def clicks_on(mouth: Mouth, rng: np.random.Generator, sigma_mm: float = 0.3) -> list[Click]:
    """Clicks on the tips of the first, third and fifth tooth of each quadrant in every camera.

    Args:
        sigma_mm: standard deviation of a click's error, at the tooth.
    """
    found = []
    for fdi, mesh in zip(mouth.fdi, mouth.teeth, strict=True):
        if fdi % 10 not in (1, 3, 5):
            continue
        rig = mouth.rig_from_scan.apply(mesh.vertices_mm)
        tip = int(rig[:, 2].argmax())
        for camera in mouth.cameras.values():
            pixel = camera.project(rig[tip][None])[0][0] + rng.normal(0, sigma_mm / camera.pixel_mm(rig[tip]), 2)
            found.append(Click(f"{fdi} tip", camera.name, mesh.vertices_mm[tip], pixel))
    return found


def drawn(camera: Camera, teeth: Sequence[Mesh], gums: Mesh, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw a photograph (H, W, 3) with shading, shadows between teeth, a lip and noise."""
    import cv2

    fine = _finer(camera)
    visible = visible_surfaces(fine, [*teeth, gums])
    label, depth = visible.mesh, visible.depth_mm
    shown = cv2.GaussianBlur(
        np.where(np.isfinite(depth), depth, depth[np.isfinite(depth)].max()).astype(np.float32), (0, 0), 2
    )
    slope = np.hypot(cv2.Sobel(shown, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(shown, cv2.CV_32F, 0, 1, scale=1 / 8))
    shade = 1 / np.sqrt(1 + (slope / (depth.min() / fine.K[0][0])) ** 2)
    colours = np.array([DARK, *[TOOTH] * len(teeth), GUMS])
    image = colours[label + 1] * np.where(label >= 0, 0.25 + 0.75 * shade, 1.0)[..., None]
    # Darken the image where two teeth meet.
    touching = np.zeros(label.shape, dtype=bool)
    for axis in (0, 1):
        one, two = np.roll(label, 1, axis), label
        touching |= (one != two) & (one >= 0) & (two >= 0) & (one < len(teeth)) & (two < len(teeth))
    image *= 1 - 0.5 * cv2.GaussianBlur(touching.astype(np.float32), (0, 0), 2.0)[..., None] * 2
    # Cover the image's lower edge with a lip.
    rows, columns = np.mgrid[0 : label.shape[0], 0 : label.shape[1]]
    lip = rows > label.shape[0] * (0.93 + 0.04 * np.cos(columns / label.shape[1] * 5 + rng.uniform(0, 6)))
    image[lip] = LIP
    image = image.reshape(camera.size[1], FINER, camera.size[0], FINER, 3).mean(axis=(1, 3))
    return np.maximum(image + rng.normal(0, NOISE, image.shape), 0).astype(np.float32)


def _finer(camera: Camera) -> Camera:
    (fx, skew, cx), (_, fy, cy), last = camera.K
    K = ((FINER * fx, FINER * skew, FINER * cx), (0.0, FINER * fy, FINER * cy), last)
    return camera.model_copy(update={"size": (FINER * camera.size[0], FINER * camera.size[1]), "K": K})


def _with_margin(camera: Camera, margin_px: int) -> Camera:
    (fx, skew, cx), (_, fy, cy), last = camera.K
    width, height = camera.size
    K = ((fx, skew, cx + margin_px), (0.0, fy, cy + margin_px), last)
    return camera.model_copy(update={"size": (width + 2 * margin_px, height + 2 * margin_px), "K": K})
