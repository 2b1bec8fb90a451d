"""Scene of a tooth for stock Mitsuba: nested homogeneous media, point lights, pinhole cameras; one colour channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.choices import chosen
from services.core.errors import CaptureInputError
from services.core.geometry import Camera
from services.core.records import Boundary
from services.core.surface.rough import DEFAULT_ROUGHNESS
from services.transport.optics.parameters import Medium, Tissue

MAX_DEPTH = 5000
"""Largest depth of a path."""
ROULETTE_DEPTH = 100
"""Path depth at which Russian roulette starts: paths in enamel scatter hundreds of times, and an earlier start costs
more variance than it saves."""
MAX_UNEVEN = 0.01
"""Largest relative difference of a camera's focal lengths along x and y: calibrations of square pixels leave a
thousandth between them."""

MIN_FILM_PIXELS = 512
"""Least width or height, whichever is larger, of an exported scene's film: what a fit needs is too coarse to be looked
at."""

SceneDict = dict[str, Any]


def medium_dict(medium: Medium) -> SceneDict:
    """Homogeneous medium; two lobes become a blended phase function.

    Raises:
        InputError: the medium's phase function is a table.
    """
    medium.require_lobes("An exported scene")
    first: SceneDict = {"type": "hg", "g": float(medium.g1)}
    second: SceneDict = {"type": "hg", "g": float(medium.g2)}
    phase = (
        first
        if medium.beta >= 1
        else {"type": "blendphase", "weight": float(1 - medium.beta), "first": first, "second": second}
    )
    return {"type": "homogeneous", "sigma_t": float(medium.sigma), "albedo": float(medium.alpha), "phase": phase}


def with_square_pixels(camera: Camera) -> Camera:
    """A calibrated camera with its mean focal length in both directions; a camera whose focal lengths differ by more
    than ``MAX_UNEVEN`` stays unchanged.

    Scenes use this camera: a hundred pixels from its principal point an image moves by a few hundredths of a pixel.
    """
    (fx, skew, cx), (zero, fy, cy), last = camera.K
    if abs(fx / fy - 1) > MAX_UNEVEN:
        return camera
    mean = float(np.sqrt(fx * fy))
    return camera.model_copy(update={"K": ((mean, skew, cx), (zero, mean, cy), last)})


def large_film(camera: Camera) -> tuple[int, int]:
    """Width and height of a film of ``MIN_FILM_PIXELS``: the camera's size times a whole number."""
    scale = -(-MIN_FILM_PIXELS // max(camera.size))
    return camera.size[0] * scale, camera.size[1] * scale


def sensor_dict(camera: Camera, samples: Any = 64, film: tuple[Any, Any] | None = None) -> SceneDict:
    """Pinhole camera with a box filter, so that a pixel is the mean radiance over its area.

    Args:
        camera: the camera.
        samples: paths per pixel of the film.
        film: width and height of the film; None for the camera's own.

    Raises:
        CaptureInputError: the camera has skew or pixels that are not square, which Mitsuba's perspective camera cannot
            render.
    """
    K, pose = np.asarray(camera.K), np.asarray(camera.camera_from_world)
    if abs(K[0, 0] / K[1, 1] - 1) > 1e-4 or abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise CaptureInputError(
            f"Camera {camera.name} has unequal focal lengths or skew, which Mitsuba cannot render; resample its images"
            " to square pixels."
        )
    width, height = camera.size
    # Mitsuba looks along +z with x to the left and y up; OpenCV has x right and y down.
    world_from_camera = np.linalg.inv(pose) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "to_world": world_from_camera,
        "fov": float(np.degrees(2 * np.arctan(width / (2 * K[0, 0])))),
        "fov_axis": "x",
        "principal_point_offset_x": float(0.5 - K[0, 2] / width),
        "principal_point_offset_y": float(0.5 - K[1, 2] / height),
        "near_clip": 1.0,
        "far_clip": 1e5,
        "film": {
            "type": "hdrfilm",
            "width": width if film is None else film[0],
            "height": height if film is None else film[1],
            "pixel_format": "luminance",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent", "sample_count": samples},
    }


def shell_integrator() -> SceneDict:
    """Integrator of a scene that is exported: unlike ``prbvolpath`` it is no Python plug-in, so the ``mitsuba`` command
    has it.
    """
    return {"type": "volpath", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}


def boundary_dict(
    boundary: Boundary,
    ior: float,
    stain: Path | None = None,
    roughness: float = DEFAULT_ROUGHNESS,
    *,
    compensated: bool = False,
) -> SceneDict:
    """BSDF of the enamel's surface, as its boundary model names it.

    Args:
        boundary: the boundary model.
        ior: refractive index of the inside relative to the outside.
        stain: picture of the absorbed share of transmitted light, 1 - a_t; without a boundary it becomes a mask before
            black.
        roughness, compensated: of a rough surface, see ``rough_surface``.
    """
    from services.assets.mitsuba.rough_surface import rough_surface
    from services.transport.boundary.models import MESH_MODELS

    model = chosen("Boundary", boundary, MESH_MODELS)
    if boundary == "rough":
        return rough_surface(ior, roughness, compensated=compensated)
    found: SceneDict = model.mitsuba(ior, stain)
    return found


TeethFiles = Mapping[str, tuple[Path, Path | None]]
"""PLY files by name of the tooth: the enamel's outer surface, and the dentin's where there is any."""


def lit_scene(light_mm: Sequence[Any], intensity: Any) -> SceneDict:
    """Scene with the integrator and a point light only."""
    return {
        "type": "scene",
        "integrator": {"type": "prbvolpath", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH},
        "light": {"type": "point", "position": list(light_mm), "intensity": intensity},
    }


def nested_scene(
    teeth: TeethFiles,
    tissue: Tissue,
    cameras: tuple[Camera, ...],
    light_mm: Sequence[Any],
    intensity: Any,
    *,
    boundary: Boundary = "matched",
    ior: float = 1.631,
    roughness: float = DEFAULT_ROUGHNESS,
    compensated: bool = False,
    samples: Any = 64,
    stains: Mapping[str, Path] = MappingProxyType({}),
) -> SceneDict:
    """Scene of teeth of one tissue under one point light, for ``load_scene`` in a mono variant or for
    ``scene_xml.write_scene``.

    Enamel lies between a tooth's two surfaces, dentin inside the inner one.

    Args:
        roughness, compensated: of a rough surface, see ``rough_surface``.
        stains: stain pictures by name of the tooth, as in ``boundary_dict``; the tooth's outer PLY file then has
            texture coordinates.
    """
    scene = lit_scene(light_mm, intensity) | {"medium_enamel": medium_dict(tissue.enamel)}
    if any(dentin is not None for _, dentin in teeth.values()):
        scene["medium_dentin"] = medium_dict(tissue.dentin)
    enamel, inner = {"type": "ref", "id": "medium_enamel"}, {"type": "ref", "id": "medium_dentin"}
    for name, (outer, dentin) in teeth.items():
        scene[f"outer_{name}"] = surface_dict(
            outer, boundary_dict(boundary, ior, stains.get(name), roughness, compensated=compensated)
        ) | {"interior": enamel}
        if dentin is not None:
            scene[f"dentin_{name}"] = surface_dict(dentin, {"type": "null"}) | {"interior": inner, "exterior": enamel}
    return scene | {f"camera_{camera.name}": sensor_dict(camera, samples) for camera in cameras}


def surface_dict(path: Path, bsdf: SceneDict) -> SceneDict:
    """Flat-shaded triangles of a PLY file."""
    return {"type": "ply", "filename": path.as_posix(), "face_normals": True, "bsdf": bsdf}


def load_scene(scene: SceneDict) -> Any:
    """Build the Mitsuba scene; the variant must be set."""
    import mitsuba as mi

    return mi.load_dict(_with_transforms(scene), optimize=False)


def _with_transforms(node: Any) -> Any:
    # Replace plain arrays by Mitsuba's transform type, which loading needs. The dictionaries hold plain arrays, so that
    # they can be written as XML without Mitsuba.
    import mitsuba as mi

    if isinstance(node, dict):
        return {key: _with_transforms(value) for key, value in node.items()}
    return mi.ScalarTransform4f(node) if isinstance(node, np.ndarray) else node


def render_batches(
    scene: Any, sensor: int, samples: int, seed: int, batches: int = 16
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image (H, W) and the variance (H, W) of its mean, from independent batches of ``samples / batches`` paths per
    pixel.
    """
    import drjit as dr
    import mitsuba as mi

    images = []
    for batch in range(batches):
        image = mi.render(scene, sensor=sensor, spp=max(1, samples // batches), seed=(seed * 1009 + batch) % 2**32)
        dr.eval(image)
        images.append(np.array(image, dtype=np.float64)[..., 0])
    stack = np.stack(images)
    return stack.mean(axis=0), stack.var(axis=0, ddof=1) / batches
