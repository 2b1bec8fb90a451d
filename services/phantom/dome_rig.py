"""A dome in front of the mouth: cameras near the front direction, point lights over the hemisphere and a little behind
the tooth's edge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light, Mesh

RADIUS_MM = 1000.0
"""Distance of cameras and lights from the origin, mm."""
WIDEST_LIGHT_DEG = 108.0
"""Largest angle between a light and the front direction, degrees. Such a light grazes the tooth and reaches it from
behind its edge; images under it determine the enamel's thickness."""
INTENSITY = 1.0e6
"""Radiant intensity that gives unit irradiance at the dome's radius, with mm as the unit of length."""
LED_WHITE = {"red": 1.0, "green": 1.0, "blue": 0.9}
"""Relative intensity of each channel."""
LED_SPREAD = 0.1
"""Relative half width of the LEDs' brightness, which a calibration has to measure."""
MARGIN_PX = 2
"""Margin around the meshes in an image, pixels."""


def dome_cameras(count: int, pixel_mm: float, meshes: tuple[Mesh, ...]) -> tuple[Camera, ...]:
    """Cameras that frame the meshes, which lie at the origin in the canonical tooth frame.

    Args:
        count: number of cameras.
        pixel_mm: size of a pixel at the origin.
        meshes: surfaces that the images must contain.
    """
    azimuth = np.radians(np.linspace(-35, 35, count) if count > 1 else np.zeros(1))
    elevation = np.radians([(-8, 10, -8, 10)[k % 4] for k in range(count)])
    return tuple(_framed(f"c{k}", _aimed(azimuth[k], elevation[k]), pixel_mm, meshes) for k in range(count))


def dome_lights(count: int, channels: tuple[str, ...], seed: int) -> tuple[Light, ...]:
    """Point lights at equal solid angles from the front (y) to ``WIDEST_LIGHT_DEG``, on a golden-angle spiral."""
    random = np.random.default_rng(seed)
    k = np.arange(count) + 0.5
    cosine = 1 - (1 - np.cos(np.radians(WIDEST_LIGHT_DEG))) * k / count
    angle = np.pi * (3 - np.sqrt(5)) * k
    sine = np.sqrt(1 - cosine**2)
    position = RADIUS_MM * np.stack([sine * np.cos(angle), cosine, sine * np.sin(angle)], axis=-1)
    brightness = 1 + LED_SPREAD * random.uniform(-1, 1, size=count)
    colours = INTENSITY * brightness[:, None] * np.array([LED_WHITE[channel] for channel in channels])
    return tuple(
        Light(
            name=f"l{n}",
            position_mm=(float(x), float(y), float(z)),
            intensity=tuple(float(value) for value in colours[n]),
        )
        for n, (x, y, z) in enumerate(position)
    )


def _aimed(azimuth: float, elevation: float) -> NDArray[np.float64]:
    # Let the image's downward axis be the occlusal one, because upper teeth hang down.
    outward = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    forward = -outward
    down = np.array([0.0, 0.0, 1.0]) - forward[2] * forward
    down /= np.linalg.norm(down)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward])
    pose[:3, 3] = -pose[:3, :3] @ (RADIUS_MM * outward)
    return pose


def _framed(name: str, pose: NDArray[np.float64], pixel_mm: float, meshes: tuple[Mesh, ...]) -> Camera:
    focal = RADIUS_MM / pixel_mm
    vertices = np.concatenate([mesh.vertices_mm for mesh in meshes])
    local = vertices @ pose[:3, :3].T + pose[:3, 3]
    image = focal * local[:, :2] / local[:, 2:3]
    low, high = np.floor(image.min(axis=0)) - MARGIN_PX, np.ceil(image.max(axis=0)) + MARGIN_PX
    width, height = (int(extent) for extent in high - low)
    K = ((focal, 0.0, float(-low[0])), (0.0, focal, float(-low[1])), (0.0, 0.0, 1.0))
    camera_from_world = tuple(tuple(float(v) for v in row) for row in pose)
    return Camera(name=name, size=(width, height), K=K, camera_from_world=camera_from_world)  # type: ignore[arg-type]
