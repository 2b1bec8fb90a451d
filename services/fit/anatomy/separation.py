"""Surfaces that bound the media of a mouth without overlapping, for renderers in which a surface knows its two sides and nothing else.

Teeth and gums are solids that overlap: a tooth counts over gums. Here each tooth's surface is cut along the gums', and the gums' along the teeth's. Cut
edges are shared bit by bit, so that no ray slips through.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import MeshError
from services.core.geometry import Mesh, Tooth
from services.fit.anatomy.patches import compact


@dataclass(frozen=True)
class SeparateSurfaces:
    """Open surfaces, outward as those of the solids; a part without a face has none in its mesh."""

    crowns: tuple[Mesh, ...]
    """Of each tooth, where air is outside."""
    roots: tuple[Mesh, ...]
    """Of each tooth, where gums are outside."""
    gums: Mesh
    """Where air is outside."""


def separate(teeth: tuple[Tooth, ...], gums: Mesh | None) -> SeparateSurfaces:
    """Cut the outer surfaces of teeth and the gums along each other.

    Raises:
        MeshError: two teeth overlap, or a surface is no solid that can be cut.
    """
    from manifold3d import Manifold, OpType

    outers = [_Solid(tooth.outer, f"teeth/{tooth.fdi}/outer.ply") for tooth in teeth]
    _require_apart(teeth, outers)
    if gums is None:
        return SeparateSurfaces(tuple(tooth.outer for tooth in teeth), tuple(_EMPTY for _ in teeth), _EMPTY)
    holder = _Solid(gums, "gums.ply")
    outside = Manifold.batch_boolean([holder.body, *(outer.body for outer in outers)], OpType.Add)
    crowns = tuple(outer.faces_in(outside) for outer in outers)
    roots = tuple(outer.faces_in(outer.body ^ holder.body) for outer in outers)
    return SeparateSurfaces(crowns, roots, holder.faces_in(outside))


_EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))


class _Solid:
    """A closed surface whose faces are known again after it was cut."""

    def __init__(self, mesh: Mesh, name: str) -> None:
        from manifold3d import Error, Manifold, Mesh64

        vertices, faces = (np.ascontiguousarray(array, dtype=kind) for array, kind in ((mesh.vertices_mm, np.float64), (mesh.faces, np.uint64)))
        self.body: Any = Manifold(Mesh64(vertices, faces))
        if self.body.status() != Error.NoError:
            raise MeshError(f"Mesh {name} cannot be cut where it meets others ({self.body.status().name}); repair it so that it is one closed surface.")
        self._number = int(self.body.to_mesh64().run_original_id[0])
        self.low, self.high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)

    def faces_in(self, body: Any) -> Mesh:
        """What is left of this surface in a combination of solids."""
        cut = body.to_mesh64()
        ends = np.asarray(cut.run_index, dtype=np.int64) // 3
        own: list[NDArray[Any]] = [
            cut.tri_verts[first:last] for number, first, last in zip(cut.run_original_id, ends[:-1], ends[1:], strict=True) if number == self._number
        ]
        faces = np.concatenate([np.zeros((0, 3), dtype=np.int32), *own]).astype(np.int32)
        return compact(Mesh(cut.vert_properties[:, :3].astype(np.float64), faces))


def _require_apart(teeth: tuple[Tooth, ...], outers: list[_Solid]) -> None:
    for (one, first), (other, second) in combinations(zip(teeth, outers, strict=True), 2):
        near = (first.low <= second.high).all() and (second.low <= first.high).all()
        if near and (shared := (first.body ^ second.body).volume()) > 0:
            raise MeshError(f"Teeth {one.fdi} and {other.fdi} overlap by {shared:.2g} mm³, so no surface between them is known; move them apart.")
