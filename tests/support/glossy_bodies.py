"""Photographs of a glossy body by stock Mitsuba, and scans of it with smooth errors."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.anatomy.visibility import vertex_normals
from services.assets.mitsuba.scene import load_scene, sensor_dict
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh
from services.fit.measurements.roughness.patches import Photograph
from services.transport.boundary.rough import Rough
from services.transport.platform import prepare_device

IOR = 1.63
INTENSITY = 1e5
RADII_MM = (4.0, 5.0, 3.0)
PIXEL_MM = 0.2
LIGHTS = tuple(
    Light(name=f"l{k}", position_mm=place, intensity=(INTENSITY,))
    for k, place in enumerate([(200.0, 120.0, -250.0), (-220.0, 60.0, -240.0), (30.0, -240.0, -260.0)])
)


def body(subdivisions: int = 5) -> Mesh:
    """An ellipsoid; its edges are 0.2 mm long at five subdivisions, and twice as long with each fewer."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(np.asarray(ball.vertices) * RADII_MM, np.asarray(ball.faces, dtype=np.int32))


def camera(name: str, turn_deg: float) -> Camera:
    """A camera 300 mm away that is turned about the body's long axis."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    pose = ((c, 0.0, -s, 0.0), (0.0, 1.0, 0.0, 0.0), (s, 0.0, c, 300.0), (0.0, 0.0, 0.0, 1.0))
    size = (46, 56)
    focal = 300.0 / PIXEL_MM
    return Camera(
        name=name,
        size=size,
        K=((focal, 0.0, size[0] / 2), (0.0, focal, size[1] / 2), (0.0, 0.0, 1.0)),
        camera_from_world=pose,
    )


CAMERAS = (camera("c0", -20.0), camera("c1", 25.0))


def scanned(mesh: Mesh, height_mm: float, length_mm: float, seed: int) -> Mesh:
    """The mesh with a random height of a Gaussian correlation along its normals."""
    random = np.random.default_rng(seed)
    waves, phases = random.normal(size=(400, 3)) / length_mm, random.uniform(0, 2 * np.pi, 400)
    height = height_mm * np.sqrt(2 / 400) * np.cos(mesh.vertices_mm @ waves.T + phases).sum(axis=1)
    return Mesh(mesh.vertices_mm + height[:, None] * vertex_normals(mesh), mesh.faces)


def render(roughness: float | None, samples: int = 64) -> NDArray[np.float64]:
    """Radiance (cameras, lights, H, W) that the body reflects once: glossy, or matte where no roughness is given."""
    images = np.zeros((len(CAMERAS), len(LIGHTS), *CAMERAS[0].size[::-1]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.ply"
        write_mesh(path, body())
        for c, one in enumerate(CAMERAS):
            for k, light in enumerate(LIGHTS):
                images[c, k] = reflected_once(path, one, light, roughness, samples, seed=10 * c + k)
    return images


def reflected_once(
    mesh: Path, camera: Camera, light: Light, roughness: float | None, samples: int, seed: int
) -> NDArray[np.float64]:
    """Radiance (H, W) that a surface reflects once: glossy, or matte where no roughness is given."""
    prepare_device()
    import mitsuba as mi

    matte = {"type": "diffuse", "reflectance": 0.4}
    surface = matte if roughness is None else Rough.mitsuba(IOR, roughness=roughness)
    scene = {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
        "sensor": sensor_dict(camera, samples),
        "body": {"type": "ply", "filename": str(mesh), "face_normals": False, "bsdf": surface},
        "lamp": {"type": "point", "position": list(light.position_mm), "intensity": light.intensity[0]},
    }
    image = np.array(mi.render(load_scene(scene), spp=samples, seed=seed), dtype=np.float64)
    return image.reshape(*camera.size[::-1], -1)[..., 0]


def photographed(images: NDArray[np.float64], seed: int, full_scale: float = np.inf) -> list[Photograph]:
    """Photographs with 1 % of noise at an image's mean; values above ``full_scale`` are saturated."""
    random, found = np.random.default_rng(seed), []
    for c, one in enumerate(CAMERAS):
        for k, light in enumerate(LIGHTS):
            found.append(photograph(images[c, k], one, light, random, full_scale))
    return found


def photograph(
    image: NDArray[np.float64], camera: Camera, light: Light, random: np.random.Generator, full_scale: float = np.inf
) -> Photograph:
    """A photograph of radiance (H, W) with 1 % of noise at its mean; values above ``full_scale`` are saturated."""
    variance = 1e-4 * image * image.mean() + (2e-3 * np.quantile(image, 0.99)) ** 2
    value = image + random.normal(size=image.shape) * np.sqrt(variance)
    clipped, (intensity,) = value > full_scale, light.intensity
    return Photograph(camera, light, value / intensity, variance / intensity**2, ~clipped, clipped)
