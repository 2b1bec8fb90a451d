"""Teeth among the shapes of somebody else's Mitsuba scene: which surface bounds which medium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.core.geometry import Mesh
from services.transport.scene.clearance import CELL_MM, Clearance
from services.transport.scene.geometry import DENTIN, ENAMEL
from services.transport.scene.mitsuba_mesh import faces_of, vertices_of

CLEARANCE_CELLS = 4_000_000
"""Largest number of cells of a distance grid; a grid of more cells takes longer to build than it saves."""


@dataclass(frozen=True)
class ToothShapes:
    """Shape ids of the surfaces around enamel, and of those around dentin inside them."""

    enamel: tuple[str, ...]
    dentin: tuple[str, ...] = ()


class SceneTeeth:
    """The teeth of one scene, with their surfaces where they are when this is built.

    A lane's *enclosure* holds bit ENAMEL inside an enamel surface and bit DENTIN inside a dentin surface, so teeth may
    not overlap.
    """

    def __init__(self, scene: Any, shapes: ToothShapes) -> None:
        """Find and check the surfaces.

        Raises:
            InputError: no shape has such an id, or one cannot be a tooth's surface.
            MeshError: a surface cannot bound a medium.
        """
        self._shapes = shapes
        self._state = _state(scene, shapes)
        by_id = {shape.id(): shape for shape in scene.shapes()}
        outer, inner = ([_solid(by_id[name]) for name in names] for names in (shapes.enamel, shapes.dentin))
        self._dentin = dict(zip(shapes.dentin, inner, strict=True))
        self.centre = np.concatenate([mesh.vertices_mm for mesh in outer]).mean(axis=0)

        # A shape is known by its number among all objects of the renderer.
        part = dict.fromkeys(shapes.enamel, ENAMEL) | dict.fromkeys(shapes.dentin, DENTIN)
        numbers = _numbers(scene)
        table = np.zeros(int(numbers.max()) + 1, dtype=np.uint32)
        table[numbers] = [part.get(shape.id(), 0) for shape in scene.shapes()]
        self._parts = mi.UInt32(table)
        dr.eval(self._parts)
        self._clearance = _clearance(outer, inner, [shape.bbox() for shape in scene.shapes() if shape.id() not in part])

    def dentin_vertices(self) -> list[tuple[str, NDArray[np.float64]]]:
        """Ids of the dentin surfaces, and their vertices (V, 3)."""
        return [(name, mesh.vertices_mm) for name, mesh in self._dentin.items()]

    def is_unchanged(self, scene: Any) -> bool:
        """Whether a scene is unchanged: its shapes are the same and none has moved."""
        now = _state(scene, self._shapes)
        return len(now) == len(self._state) and all(np.array_equal(a, b) for a, b in zip(now, self._state, strict=True))

    def part(self, found: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.UInt32:
        """Part that the hit surface bounds: ENAMEL, DENTIN, or 0 where it belongs to no tooth."""
        # A hit in an instance has no shape; its number is then 0, which is no tooth's.
        return dr.gather(mi.UInt32, self._parts, dr.reinterpret_array(mi.UInt32, found.shape), active)

    def medium(self, enclosure: mi.UInt32) -> mi.UInt32:
        """Medium of an enclosure: dentin over enamel over the outside (0)."""
        return dr.select((enclosure & DENTIN) != 0, DENTIN, enclosure & ENAMEL)

    def beyond(self, enclosure: mi.UInt32, part: mi.UInt32, cosine: mi.Float) -> mi.UInt32:
        """Place after crossing a surface at ``cosine`` between direction and outward normal; the next hit corrects a
        missed one.
        """
        return dr.select(cosine < 0, enclosure | part, enclosure & ~part)

    def clearance(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Distance within which no surface lies; not positive where that is not known."""
        return mi.Float(0) if self._clearance is None else self._clearance(point, active)


def _numbers(scene: Any) -> NDArray[np.uint32]:
    return np.asarray(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy())


def _state(scene: Any, shapes: ToothShapes) -> list[NDArray[Any]]:
    by_id = {shape.id(): shape for shape in scene.shapes()}
    for name in (*shapes.enamel, *shapes.dentin):
        if name not in by_id:
            known = ", ".join(sorted(filter(None, by_id))) or "no shape with an id"
            raise InputError(
                f"The scene has no shape '{name}' but {known}; correct the id, and load the scene with optimize=False"
                " so that ids survive."
            )
        if not by_id[name].is_mesh():
            raise InputError(f"Shape '{name}' is no triangle mesh; give the tooth's surface as a mesh file.")
        if by_id[name].is_emitter():
            raise InputError(f"Shape '{name}' is a light, which a tooth's surface cannot be; remove its emitter.")
    boxes = [(shape.bbox().min, shape.bbox().max) for shape in by_id.values()]
    vertices = [vertices_of(by_id[name]) for name in (*shapes.enamel, *shapes.dentin)]
    return [np.array([shape.id() for shape in scene.shapes()]), _numbers(scene), np.array(boxes), *vertices]


def _solid(shape: Any) -> Mesh:
    # Merge vertices that were split for texture seams or normals.
    welded, index = np.unique(vertices_of(shape).astype(np.float64), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces_of(shape)].astype(np.int32)
    mesh = Mesh(welded, faces[:, ::-1] if shape.has_flipped_normals() else faces)
    mesh.require_solid(f"'{shape.id()}'", extent_mm=(0.0, np.inf))
    return mesh


def _clearance(outer: list[Mesh], inner: list[Mesh], other_boxes: list[Any]) -> Clearance | None:
    # Build a grid only for a single tooth into whose box no other shape reaches; elsewhere every flight is traced.
    low, high = outer[0].vertices_mm.min(axis=0), outer[0].vertices_mm.max(axis=0)
    near = any((np.array(box.min) < high).all() and (np.array(box.max) > low).all() for box in other_boxes)
    if len(outer) > 1 or near or np.prod((high - low) / CELL_MM + 2) > CLEARANCE_CELLS:
        return None
    grid = Clearance(outer[0].vertices_mm, outer[0].faces)
    if inner:
        grid.move_inner(inner)
    return grid
