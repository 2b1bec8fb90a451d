"""Renders of a tooth of given media under light from all around, by the ``dentine`` integrator, one colour channel at a
time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.mitsuba.scene import load_scene, sensor_dict
from services.bench.figures.gallery import render
from services.core.errors import InputError
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Mesh
from services.transport.optics.parameters import Tissue
from services.transport.platform import prepare_device

Array = NDArray[np.float64]
Surfaces = Mapping[str, Mesh]
"""Surfaces of a tooth by name: ``outer``, and ``dentin`` if there is dentin."""


def read_environment(path: Path) -> Array:
    """Read an equirectangular image (H, W, 3) of linear radiance, scaled to a mean of 1 over the sphere and channels.

    Raises:
        InputError: the file does not exist.
    """
    if not path.is_file():
        raise InputError(f"Environment image {path} does not exist; give an equirectangular EXR or HDR file.")
    prepare_device()
    import mitsuba as mi

    image = np.array(
        mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False),
        dtype=np.float64,
    )
    height = len(image)
    solid_angle = np.sin(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    return np.asarray(image * (solid_angle.sum() * image.shape[1] * 3 / (image * solid_angle).sum()))


def environment_light(image: Array, turn_degrees: float) -> dict[str, Any]:
    """Return an emitter of one channel (H, W) around a tooth whose z axis is occlusal. The top of the image lies
    towards the roots, as for the upper teeth of a person who sits upright.
    """
    prepare_device()
    import mitsuba as mi

    place = mi.ScalarTransform4f()
    turned = place.rotate([0, 0, 1], turn_degrees).rotate([1, 0, 0], -90)
    return {"type": "envmap", "bitmap": mi.Bitmap(image[..., None].astype(np.float32)), "to_world": turned}


def render_under(
    light: dict[str, Any],
    surfaces: Surfaces,
    tissue: Tissue,
    camera: Camera,
    *,
    samples: int,
    boundary: str,
    ior: float,
    roughness: float | None,
) -> Array:
    """Render the radiance (H, W) of one channel.

    Args:
        light: Mitsuba dictionary of an emitter.
        surfaces: surfaces of the tooth.
        tissue: media of the tooth.
        camera: the camera.
        samples: paths per pixel.
        boundary: name of the boundary model.
        ior: index of refraction of the tooth.
        roughness: GGX roughness of the mirror reflection on the enamel; None for no reflection.
    """
    prepare_device()
    from services.transport.plugin.integrator import medium_properties, register_integrator

    register_integrator()
    parts = {"enamel": "outer"} | ({"dentin": "dentin"} if "dentin" in surfaces else {})
    integrator: dict[str, Any] = {"type": "dentine", "boundary": boundary, "ior": ior} | (
        {} if roughness is None else {"roughness": roughness}
    )
    for part, name in parts.items():
        integrator |= {part: name} | medium_properties(part, (tissue.medium(part),))
    with tempfile.TemporaryDirectory() as folder:
        scene: dict[str, Any] = {"type": "scene", "light": light, "camera": sensor_dict(camera)}
        for name in parts.values():
            path = Path(folder) / f"{name}.ply"
            write_mesh(path, surfaces[name])
            scene[name] = {"type": "ply", "filename": str(path), "face_normals": True}
        image = render(load_scene(scene), integrator, samples)
    return np.asarray(image[..., 0])
