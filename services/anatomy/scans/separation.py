"""Surfaces that bound the media of a mouth without overlapping, for renderers in which a surface only defines the media
on its two sides.

Teeth and gums are solids that overlap. A tooth takes precedence over gums, and of two teeth the one listed first. Here
each surface is cut along the others. Two surfaces share their cut edge bit for bit, so that no ray slips through; at
points where three surfaces meet, they agree up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.patches import compact
from services.core.errors import MeshError
from services.core.geometry import Mesh, Tooth


@dataclass(frozen=True)
class SeparateSurfaces:
    """Open surfaces, oriented outward like those of the solids; a surface that does not occur has no faces."""

    crowns: tuple[Mesh, ...]
    """For each tooth, the part of its surface with air outside."""
    roots: tuple[Mesh, ...]
    """For each tooth, the part of its surface with gums outside."""
    gums: Mesh
    """Part of the gums' surface with air outside."""
    contacts: dict[tuple[int, int], Mesh]
    """Part of a tooth's surface with another tooth outside, by the indices of both, the one listed first before the
    other."""


def separate(teeth: tuple[Tooth, ...], gums: Mesh | None) -> SeparateSurfaces:
    """Cut the outer surfaces of teeth and the gums along each other.

    Args:
        teeth: teeth in order of precedence.
        gums: solid of the gums; None without gums.

    Raises:
        MeshError: a surface is not a solid that can be cut, or a tooth reaches into another one's dentin.
    """
    from manifold3d import Manifold, OpType

    outers = [_Solid(tooth.outer, f"teeth/{tooth.fdi}/outer.ply") for tooth in teeth]
    # Find the contact surface of each pair of teeth, and cut the later tooth back by the earlier one
    contacts, remaining = {}, [outer.body for outer in outers]
    for (i, first), (j, second) in combinations(enumerate(outers), 2):
        if first.near(second) and len((shared := first.faces_in(remaining[i] ^ second.body)).faces):
            _require_whole_dentin(teeth[i], first, teeth[j])
            _require_whole_dentin(teeth[j], second, teeth[i])
            contacts[i, j] = shared
            remaining[j] -= first.body
    together = Manifold.batch_boolean([outer.body for outer in outers], OpType.Add)
    if gums is None:
        return SeparateSurfaces(
            tuple(outer.faces_in(together) for outer in outers), (_EMPTY,) * len(teeth), _EMPTY, contacts
        )
    gums_solid = _Solid(gums, "gums.ply")
    outside, within = together + gums_solid.body, together ^ gums_solid.body
    crowns, roots = (tuple(outer.faces_in(body) for outer in outers) for body in (outside, within))
    return SeparateSurfaces(crowns, roots, gums_solid.faces_in(outside), contacts)


_EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))


class _Solid:
    """A closed surface whose faces can be identified after it was cut."""

    def __init__(self, mesh: Mesh, name: str) -> None:
        from manifold3d import Error, Manifold, Mesh64

        vertices, faces = (
            np.ascontiguousarray(array, dtype=kind)
            for array, kind in ((mesh.vertices_mm, np.float64), (mesh.faces, np.uint64))
        )
        self.body: Any = Manifold(Mesh64(vertices, faces))
        if self.body.status() != Error.NoError:
            raise MeshError(
                f"Mesh {name} cannot be cut where it meets others ({self.body.status().name}); repair it so that it is"
                " one closed surface."
            )
        self._number = int(self.body.to_mesh64().run_original_id[0])
        self._low, self._high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)

    def near(self, other: _Solid) -> bool:
        """Whether the bounding boxes of both overlap."""
        return bool((self._low <= other._high).all() and (other._low <= self._high).all())

    def faces_in(self, body: Any) -> Mesh:
        """Part of this surface that belongs to the surface of a combination of solids."""
        cut = body.to_mesh64()
        ends = np.asarray(cut.run_index, dtype=np.int64) // 3
        own: list[NDArray[Any]] = [
            cut.tri_verts[first:last]
            for number, first, last in zip(cut.run_original_id, ends[:-1], ends[1:], strict=True)
            if number == self._number
        ]
        faces = np.concatenate([np.zeros((0, 3), dtype=np.int32), *own]).astype(np.int32)
        return compact(Mesh(cut.vert_properties[:, :3].astype(np.float64), faces))


def _require_whole_dentin(tooth: Tooth, outer: _Solid, other: Tooth) -> None:
    if (
        other.dentin is not None
        and not (outer.body ^ _Solid(other.dentin, f"teeth/{other.fdi}/dentin.ply").body).is_empty()
    ):
        raise MeshError(
            f"Tooth {tooth.fdi} reaches into the dentin of tooth {other.fdi}, so no surface between them is known; move"
            " them apart."
        )
