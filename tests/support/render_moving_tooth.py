"""Render frames of a moving tooth with stock Mitsuba, with and without their specular part.

Run as ``python -m tests.support.render_moving_tooth OUT.npz OPTIONS_JSON`` so that the Mitsuba variant of the calling
process stays as it is.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
DISTANCE_MM = 1000.0


def tooth_mesh(rings: int = 96) -> tuple[FloatArray, NDArray[np.int32]]:
    """A closed surface like an incisor's, broad and tapered with three faint vertical ridges: vertices (V, 3) in mm and
    faces (F, 3) that face outwards.
    """
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    azimuth = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    direction = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1).reshape(-1, 3)
    direction = np.concatenate([direction, [[0, 0, 1], [0, 0, -1]]])
    # A superellipsoid of exponent 2.6, thinner towards the cutting edge (+z)
    radius = (np.abs(direction) ** 2.6).sum(axis=1) ** (-1 / 2.6)
    unit = direction * radius[:, None]
    ridge = 1 + 0.015 * np.cos(9 * unit[:, 0])
    thickness = 3.2 * (1 - 0.35 * unit[:, 2])
    vertices = np.stack(
        [4.2 * unit[:, 0] * (1 + 0.12 * unit[:, 2]), thickness * unit[:, 1] * ridge, 5.5 * unit[:, 2]], axis=1
    )
    columns, rows = 2 * rings, rings - 1
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    upper, lower = i * columns + j, (i + 1) * columns + j
    upper_next, lower_next = i * columns + (j + 1) % columns, (i + 1) * columns + (j + 1) % columns
    quads = [
        np.stack([upper, lower, upper_next], -1).reshape(-1, 3),
        np.stack([upper_next, lower, lower_next], -1).reshape(-1, 3),
    ]
    ring = np.arange(columns)
    top, bottom = rows * columns, rows * columns + 1
    last = (rows - 1) * columns
    caps = [
        np.stack([np.full(columns, top), ring, np.roll(ring, -1)], -1),
        np.stack([np.full(columns, bottom), last + np.roll(ring, -1), last + ring], -1),
    ]
    return vertices, np.concatenate([*quads, *caps]).astype(np.int32)


def tooth_colour(x: FloatArray, z: FloatArray) -> FloatArray:
    """Diffuse reflectance (..., 3) by position in the front view in mm. It is yellowish, more so towards the root, with
    faint stains as optical flow tracks them on a real tooth.
    """
    rng = np.random.default_rng(7)
    stain = np.zeros_like(x)
    for k in range(60):
        wave = rng.normal(scale=(1.6, 6.0)[k % 2], size=2)  # rad/mm: patches of 4 mm, streaks of 1 mm
        stain += np.cos(wave[0] * x + wave[1] * z + rng.uniform(0, 2 * np.pi)) / 60**0.5
    root = 1 / (1 + np.exp(0.8 * z + 1))
    level = 0.62 * (1 + 0.05 * stain) * (1 - 0.15 * root)
    return level[..., None] * np.stack(
        [np.ones_like(x), 0.94 - 0.05 * root, 0.82 - 0.12 * root - 0.02 * stain], axis=-1
    )


def camera_from_world(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    """Pose of a camera DISTANCE_MM in front (+y) of the tooth, OpenCV axes, image up along +z."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    backward = np.array([np.sin(az) * np.cos(el), np.cos(az) * np.cos(el), np.sin(el)])
    forward = -backward
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (DISTANCE_MM * backward)
    return pose


def motion(time: float, amplitude_mm: float) -> FloatArray:
    """Rigid motion (4, 4) of the subject at a time in 0..1, the identity at 0: breathing and a slow nod, smooth and
    without a whole period during the capture.
    """
    shift = amplitude_mm * np.array([np.sin(2.6 * time), 0.5 * np.sin(1.9 * time), 0.8 * (1 - np.cos(3.1 * time)) / 2])
    nod = np.radians(0.9) * amplitude_mm * np.sin(2.2 * time)
    turn = np.radians(0.6) * amplitude_mm * (1 - np.cos(2.4 * time))
    rx = np.array([[1, 0, 0], [0, np.cos(nod), -np.sin(nod)], [0, np.sin(nod), np.cos(nod)]])
    rz = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rz @ rx, shift
    return pose


def light_positions(count: int) -> FloatArray:
    """Positions (L, 3) in mm of ``count`` lights on the front half of a dome around the tooth."""
    k = np.arange(count) + 0.5
    az = np.pi * (3 - 5**0.5) * np.arange(count)
    el = np.arccos(1 - 0.65 * k / count)
    return 980.0 * np.stack([np.sin(el) * np.cos(az), np.cos(el), np.sin(el) * np.sin(az)], axis=1)


def render(options: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """Render the frames of ``options["frames"]``, a list of (light index or -1 for all lights on, time in 0..1).

    Returns:
        ``total`` and ``diffuse`` radiance (camera, frame, y, x, 3) float32, the latter 0 in frames with all lights on,
        and the arrays that describe the capture.
    """
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    vertices, faces = tooth_mesh(options.get("rings", 96))
    # Texture coordinates are the front view, 16 mm across
    x, z = np.meshgrid(16 * (np.arange(512) + 0.5) / 512 - 8, 8 - 16 * (np.arange(512) + 0.5) / 512)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(tooth_colour(x, z).astype(np.float32)), "raw": True}
    uv = vertices[:, [0, 2]] / 16 + 0.5
    width, height = options["size"]
    focal = DISTANCE_MM / options["pixel_mm"]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    poses = [camera_from_world(az, el) for az, el in options["views_deg"]]
    lights = light_positions(options["lights"])
    intensity = np.asarray(options.get("light_colour", [1.0, 0.9, 0.75])) * 1e6

    def tooth(pose: FloatArray) -> Any:
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(
            {
                "type": "roughplastic",
                "distribution": options.get("distribution", "ggx"),
                "alpha": options.get("roughness", 0.1),
                "int_ior": 1.631,
                "nonlinear": False,
                "diffuse_reflectance": texture,
                "specular_reflectance": 1.0,
            }
        )
        mesh = mi.Mesh(
            "tooth", len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties
        )
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = (vertices @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32).ravel()
        parameters["faces"] = faces.astype(np.uint32).ravel()
        parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
        parameters.update()
        mesh.recompute_vertex_normals()
        return mesh

    def sensor(pose: FloatArray) -> dict[str, Any]:
        # Mitsuba's camera looks along +z with x to the left; OpenCV's has x right, y down
        to_world = np.linalg.inv(pose) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        return {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(width / 2 / focal))),
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(to_world),
            "near_clip": 1.0,
            "far_clip": 5000.0,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent", "sample_count": options.get("spp", 16)},
        }

    shape = (len(poses), len(options["frames"]), height, width, 3)
    total, diffuse = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": intensity.tolist()}}
    for frame, (light, time) in enumerate(options["frames"]):
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct"},
                "tooth": tooth(motion(time, options["amplitude_mm"])),
                "lamp": lamp,
                **{f"sensor{k}": sensor(pose) for k, pose in enumerate(poses)},
            }
        )
        parameters = mi.traverse(scene)
        for images, specular in ((total, 1.0), (diffuse, 0.0)):
            parameters["tooth.bsdf.specular_reflectance.value"] = specular
            # Render light by light, because a random choice of the light per sample would add noise. The diffuse image
            # is needed for frames of single lights alone.
            for k in [light] if light >= 0 else range(len(lights) if specular else 0):
                parameters["lamp.position"] = lights[k].tolist()
                parameters.update()
                for view in range(len(poses)):
                    images[view, frame] += np.array(mi.render(scene, sensor=view, seed=11))
    return {
        "total": total,
        "diffuse": diffuse,
        "vertices_mm": vertices,
        "faces": faces,
        "K": K,
        "camera_from_world": np.asarray(poses),
        "lights_mm": lights,
        "intensity": intensity,
        "motions": np.asarray([motion(time, options["amplitude_mm"]) for _, time in options["frames"]]),
    }


if __name__ == "__main__":
    arrays = render(json.loads(sys.argv[2]))
    np.savez(Path(sys.argv[1]), **arrays)  # type: ignore[arg-type]  # none is called allow_pickle
