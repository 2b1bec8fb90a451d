"""Read and write meshes: the one place that chooses a mesh file format. ``surface_files`` does the parsing; ``scans``
reads labelled scans.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError, MeshError
from services.core.files.surface_files import read_surface, require_file, require_triangles
from services.core.geometry import OBJECT, Mesh, Tooth, inner_file, teeth_folder

FDI_NUMBERS = frozenset(
    10 * quadrant + place for quadrant in range(1, 9) for place in range(1, 9 if quadrant < 5 else 6)
)
"""FDI numbers of all teeth: permanent teeth in quadrants 1 to 4, milk teeth in 5 to 8."""
TOOTH_EXTENT_MM = (2.0, 45.0)
"""Smallest and largest extent of a tooth, mm; the longest tooth ever measured has 37 mm."""
OBJECT_EXTENT_MM = (0.5, 1000.0)
"""Smallest and largest extent of an object that is no tooth, mm: beyond, single precision or a rig's cameras end."""
MIN_SPACING_MM = 2.0
"""Smallest distance between the centres of two teeth, mm; the narrowest teeth, lower incisors, stand 5 mm apart."""


def read_mesh(path: Path) -> Mesh:
    """Read a PLY, OBJ or STL file in mm; vertices at the same place are merged, vertices that no face uses are dropped,
    and no face is flipped.

    Raises:
        CaptureInputError: the file is absent or no triangle mesh.
    """
    require_file(path)
    try:
        surface = read_surface(path)
        vertices, faces = surface.vertices, surface.faces
    except Exception as problem:
        raise CaptureInputError(f"Mesh file {path} cannot be read ({problem}); export it again as PLY.") from problem
    require_triangles(path, faces, len(vertices))
    used, corner = np.unique(faces, return_inverse=True)
    welded, index = np.unique(vertices[used], axis=0, return_inverse=True)
    return Mesh(welded, index.reshape(-1)[corner.reshape(-1, 3)].astype(np.int32), len(vertices) - len(used))


def read_texture_coordinates(path: Path) -> NDArray[np.float64] | None:
    """Texture coordinates (F, 3, 2) of the corners of a PLY file's faces, in the order of ``read_mesh``; None where it
    has none.
    """
    surface = read_surface(path)
    points = surface.elements["vertex"]["data"] if surface.elements else None
    if points is None or not {"u", "v"} <= set(points.dtype.names or ()):
        return None
    uv = np.stack([points["u"], points["v"]], axis=-1).astype(np.float64)
    return np.asarray(uv.reshape(-1, 2)[surface.faces])


def note_on_dropped(meshes: Mapping[str, Mesh]) -> str | None:
    """A sentence on vertices that no face uses and that were dropped, by the meshes' names; None where all are used."""
    dropped = {name: mesh.dropped_vertices for name, mesh in meshes.items() if mesh.dropped_vertices}
    if not dropped:
        return None
    counts = ", ".join(f"{count} of {name}" for name, count in dropped.items())
    return f"Vertices that no triangle uses are left out: {counts}."


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY with float32 coordinates."""
    import trimesh

    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(path)


def write_mapped_mesh(path: Path, mesh: Mesh, corners_uv: NDArray[np.float64]) -> None:
    """Write a binary PLY with texture coordinates ``u`` and ``v``.

    Vertices on a seam are written once for each side of it.

    Args:
        corners_uv: texture coordinates of each face's corners, (F, 3, 2).
    """
    corners = np.concatenate([mesh.vertices_mm[mesh.faces], corners_uv], axis=-1).astype("<f4").reshape(-1, 5)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, index.reshape(-1, 3)
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "u", "v"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}element face {len(faces)}\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        f"{head}property list uchar int vertex_indices\nend_header\n".encode() + vertices.tobytes() + faces.tobytes()
    )


def fdi_numbers(root: Path) -> tuple[int, ...]:
    """FDI numbers that name the folders below ``root/teeth``, in ascending order."""
    return tuple(sorted(int(p.name) for p in (root / "teeth").glob("*") if p.name.isascii() and p.name.isdigit()))


def read_teeth(root: Path, fdi: tuple[int, ...] | None = None, *, verify: bool = True) -> tuple[Tooth, ...]:
    """Read and check every tooth below ``root/teeth``.

    Args:
        fdi: numbers of the teeth to read, or ``OBJECT`` alone; None for all teeth.
        verify: whether the surfaces are checked, which takes longer than to read them.

    Raises:
        CaptureInputError: no tooth is there. MeshError: a surface cannot bound a medium.
    """
    numbers = fdi_numbers(root) if fdi is None else fdi
    known = FDI_NUMBERS if fdi is None else FDI_NUMBERS | {OBJECT}
    if (unknown := next((number for number in numbers if number not in known), None)) is not None:
        what = f"{root / 'teeth' / str(unknown)} is of tooth {unknown}, which is no FDI number"
        raise CaptureInputError(
            f"{what}; permanent teeth are 11 to 18, 21 to 28, 31 to 38 and 41 to 48, milk teeth 51 to 55 and so on"
            " to 85."
        )
    if not numbers:
        raise CaptureInputError(f"No tooth mesh below {root / 'teeth'}; put teeth/<FDI>/outer.ply there.")
    teeth = []
    for number in numbers:
        outer_name, inner_name = (teeth_folder(Path(), number) / name for name in ("outer.ply", inner_file(number)))
        extent_mm = OBJECT_EXTENT_MM if number == OBJECT else TOOTH_EXTENT_MM
        outer = read_mesh(root / outer_name)
        if verify:
            outer.require_solid(str(outer_name), extent_mm)
            outer.require_one_shell(str(outer_name))
        dentin = read_mesh(root / inner_name) if (root / inner_name).exists() else None
        if verify and dentin is not None:
            dentin.require_solid(str(inner_name), extent_mm)
        teeth.append(Tooth(number, outer, dentin))
    if verify:
        _require_apart(teeth)
    return tuple(teeth)


def _require_apart(teeth: list[Tooth]) -> None:
    centres = [tooth.outer.vertices_mm.mean(axis=0) for tooth in teeth]
    for k, tooth in enumerate(teeth):
        for n in range(k):
            if np.linalg.norm(centres[k] - centres[n]) < MIN_SPACING_MM:
                what = (
                    f"Teeth {teeth[n].fdi} and {tooth.fdi} lie in each other: their centres are less than"
                    f" {MIN_SPACING_MM:g} mm apart"
                )
                raise MeshError(f"{what}; export each in its own place.")
