"""A small mouth: a tooth with dentin whose root is in gums, a tooth without dentin that hangs beside it, and a wall
behind both.

The first tooth is a solid of revolution with a ring of vertices in the plane where the gums' flat top cuts it. So the
same media can also be bounded by surfaces that do not overlap, as stock Mitsuba needs them: the parts of the tooth
above and below that plane, and a gums' top with a hole.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.assets.mitsuba.scene import boundary_dict, medium_dict, sensor_dict
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Mesh
from services.core.records import Boundary
from services.core.surface.rough import DEFAULT_ROUGHNESS
from services.transport.optics.parameters import Medium, Mouth, Tissue
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces
from tests.support.small_tooth import INTENSITY

AROUND, ALONG = 48, 24
"""Vertices around a solid of revolution, and intervals between its poles; the latter is even so that one row of
vertices is the equator."""
GUMS_RADIUS_MM, GUMS_DEPTH_MM = 4.0, 3.0
IOR, GUMS_IOR = 1.631, 1.33
LIGHTS_MM = np.array([[100, 500, 300], [-500, 250, 50.0]])
MOUTH = Mouth(
    (
        Tissue(Medium(1.5, 0.95, 0.8, 0.6, -0.3), Medium(4.0, 0.85, 1.0, 0.5)),
        Tissue(Medium(2.0, 0.9, 1.0, 0.4), Medium(1.0, 0.5)),
    ),
    Medium(2.5, 0.8, 1.0, 0.6),
    0.5,
)


def revolved(semi_axes_mm: tuple[float, float], centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A spheroid about a vertical axis, given its radius and half height, with its equator as a row of vertices."""
    radius, height = semi_axes_mm
    polar = np.linspace(0, np.pi, ALONG + 1)[1:-1]
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    rows = np.stack(
        np.broadcast_arrays(
            radius * np.sin(polar)[:, None] * np.cos(turn),
            radius * np.sin(polar)[:, None] * np.sin(turn),
            height * np.cos(polar)[:, None],
        ),
        axis=-1,
    )
    vertices = np.concatenate([[[0, 0, height]], rows.reshape(-1, 3), [[0, 0, -height]]]) + centre_mm
    last, k = len(vertices) - 1, np.arange(AROUND)
    following = (k + 1) % AROUND
    faces = [np.stack([0 * k, 1 + k, 1 + following], axis=1)]
    for row in range(ALONG - 2):
        upper, lower = 1 + row * AROUND, 1 + (row + 1) * AROUND
        faces += [
            np.stack([upper + k, lower + k, lower + following], axis=1),
            np.stack([upper + k, lower + following, upper + following], axis=1),
        ]
    bottom = 1 + (ALONG - 2) * AROUND
    faces.append(np.stack([bottom + k, 0 * k + last, bottom + following], axis=1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


ROOTED, CORE = revolved((2.0, 3.0)), revolved((1.5, 2.4))
FREE_MM = (4.4, 0.3, 1.2)
FREE = revolved((1.6, 2.2), FREE_MM)


def gums(hole_radius_mm: float = 0.0) -> Mesh:
    """A cylinder with its top in the plane z = 0. With a hole, it is the open surface that lies outside the tooth."""
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    top, low = GUMS_RADIUS_MM * ring, GUMS_RADIUS_MM * ring - [0, 0, GUMS_DEPTH_MM + 1.0]
    inner = hole_radius_mm * ring if hole_radius_mm else np.zeros((1, 3))
    vertices = np.concatenate([top, low, [[0, 0, low[0, 2]]], inner])
    k = np.arange(AROUND)
    following, hub, first = (k + 1) % AROUND, 2 * AROUND, 2 * AROUND + 1
    faces = [
        np.stack([k, AROUND + k, AROUND + following], axis=1),
        np.stack([k, AROUND + following, following], axis=1),
        np.stack([AROUND + k, 0 * k + hub, AROUND + following], axis=1),
    ]
    if hole_radius_mm:
        faces += [
            np.stack([first + k, k, following], axis=1),
            np.stack([first + k, following, first + following], axis=1),
        ]
    else:
        faces.append(np.stack([0 * k + first, k, following], axis=1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def wall() -> Mesh:
    """An open rectangle behind the teeth."""
    corners = np.array([[-7.0, -3.2, -5], [9, -3.2, -5], [9, -3.2, 5], [-7, -3.2, 5]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def mouth_recipe(boundary: Boundary) -> SceneRecipe:
    """The mouth's scene for the engine, whose solids overlap."""
    known = DentinShape.known(CORE)
    teeth = (ToothSurfaces(ROOTED, known), ToothSurfaces(FREE))
    return SceneRecipe(
        teeth, LIGHTS_MM, np.full(2, INTENSITY), boundary, IOR, gums=gums(), gums_ior=GUMS_IOR, cavity=wall()
    )


def stock_mouth(
    folder: Path,
    camera: Camera,
    light: int,
    boundary: Boundary,
    samples: int,
    *,
    mouth: Mouth = MOUTH,
    roughness: float = DEFAULT_ROUGHNESS,
) -> dict[str, Any]:
    """The same scene for stock Mitsuba, made of surfaces that do not overlap."""
    height = ROOTED.vertices_mm[ROOTED.faces].mean(axis=1)[:, 2]
    parts = {
        "crown": Mesh(ROOTED.vertices_mm, ROOTED.faces[height > 0]),
        "root": Mesh(ROOTED.vertices_mm, ROOTED.faces[height < 0]),
    }
    parts |= {"core": CORE, "free": FREE, "gums": gums(2.0), "wall": wall()}
    for name, mesh in parts.items():
        write_mesh(folder / f"{name}.ply", mesh)
    rooted, free = mouth.teeth
    assert mouth.gums is not None
    media = {"enamel": rooted.enamel, "dentin": rooted.dentin, "other": free.enamel, "flesh": mouth.gums}

    def surface(name: str, ior: float, inside: str, outside: str | None = None) -> dict[str, Any]:
        sides = {"interior": {"type": "ref", "id": f"medium_{inside}"}} | (
            {"exterior": {"type": "ref", "id": f"medium_{outside}"}} if outside else {}
        )
        bsdf = {"type": "null"} if ior == 1 else boundary_dict(boundary, ior, roughness=roughness)
        return {
            "type": "ply",
            "filename": (folder / f"{name}.ply").as_posix(),
            "face_normals": True,
            "bsdf": bsdf,
        } | sides

    return (
        {
            "type": "scene",
            "integrator": {"type": "prbvolpath", "max_depth": 5000, "rr_depth": 100},
            "light": {"type": "point", "position": LIGHTS_MM[light].tolist(), "intensity": INTENSITY},
            "camera": sensor_dict(camera, samples),
        }
        | {f"medium_{name}": medium_dict(medium) for name, medium in media.items()}
        | {
            "crown": surface("crown", IOR, "enamel"),
            "root": surface("root", IOR / GUMS_IOR, "enamel", "flesh"),
            "core": surface("core", 1.0, "dentin", "enamel"),
            "free": surface("free", IOR, "other"),
            "gums": surface("gums", GUMS_IOR, "flesh"),
            "wall": {
                "type": "ply",
                "filename": (folder / "wall.ply").as_posix(),
                "face_normals": True,
                "bsdf": {
                    "type": "twosided",
                    "nested": {"type": "diffuse", "reflectance": {"type": "uniform", "value": mouth.reflectance}},
                },
            },
        }
    )
