"""Triangle meshes as Mitsuba holds them.

Mitsuba 3.10 renames the parameters of meshes, so this module alone knows their names. Mitsuba's variant must be chosen
before its functions are called.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

VERTICES, FACES = "vertex_positions", "faces"
"""Names of the parameters that hold the corners' coordinates and the triangles' corners, each as one flat array."""


def new_mesh(name: str, vertices_mm: NDArray[np.float64], faces: NDArray[np.integer[Any]]) -> Any:
    """A mesh of vertices (V, 3) and triangles (F, 3)."""
    import mitsuba as mi

    mesh = mi.Mesh(name, len(vertices_mm), len(faces))
    parameters = mi.traverse(mesh)
    parameters[FACES] = mi.UInt32(np.ascontiguousarray(faces, dtype=np.uint32).reshape(-1))
    parameters[VERTICES] = _flat(vertices_mm)
    parameters.update()
    return mesh


def move_vertices(scene_parameters: Any, name: str, vertices_mm: NDArray[np.float64]) -> None:
    """Put the vertices (V, 3) of a scene's mesh elsewhere; takes the parameters that ``mi.traverse`` gives for the
    scene.
    """
    scene_parameters[f"{name}.{VERTICES}"] = _flat(vertices_mm)
    scene_parameters.update()


def vertices_of(mesh: Any) -> NDArray[np.float32]:
    """Vertices (V, 3) of a mesh."""
    return _parameter(mesh, VERTICES).reshape(-1, 3)


def faces_of(mesh: Any) -> NDArray[np.uint32]:
    """Triangles (F, 3) of a mesh."""
    return _parameter(mesh, FACES).reshape(-1, 3)


def _parameter(mesh: Any, name: str) -> NDArray[Any]:
    import mitsuba as mi

    return np.array(mi.traverse(mesh)[name])


def _flat(vertices_mm: NDArray[np.float64]) -> Any:
    import mitsuba as mi

    return mi.Float(np.ascontiguousarray(vertices_mm, dtype=np.float32).reshape(-1))
