"""Read the file of a scan unchanged, with its data arrays of triangles and vertices: VTK PolyData, PLY, STL and OBJ."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.json_text import parse_json
from services.core.files.surface_files import read_surface, require_file, require_triangles
from services.core.files.tables import read_text
from services.core.files.vtk_polydata import read_polydata
from services.core.geometry import Mesh

FORMATS = (".vtp", ".ply", ".stl", ".obj")
SIDECARS = (".json", ".npy", ".txt", ".csv")
MAX_TRIANGLES = 2_000_000
"""Largest number of triangles of a scan: ten times those of a fine intra-oral scan. Repairing more takes minutes and
gigabytes, and shows nothing more of a tooth."""
STL_HEADER_BYTES, STL_TRIANGLE_BYTES = 84, 50
"""Sizes in a binary STL file: a header of 80 bytes of text and a count, then 50 bytes per triangle."""
PLY_HEAD_BYTES = 65536
"""Number of bytes read from a PLY file: enough for its header, which states the number of faces."""


@dataclass(frozen=True)
class ScanFile:
    """A surface in the unit of its file, with arrays by name: per triangle (F,) or (F, components), per vertex (V,)."""

    mesh: Mesh
    triangle_arrays: dict[str, NDArray[Any]]
    vertex_arrays: dict[str, NDArray[Any]]


def read_scan_file(path: Path) -> ScanFile:
    """Read a scan; no vertices are merged and no faces are flipped.

    Raises:
        CaptureInputError: the file is absent, unreadable, of another format, or has more triangles than a scan has.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise CaptureInputError(f"Scan {path} is neither .vtp, .ply, .stl nor .obj; export it as one of these.")
    require_file(path)
    require_few_triangles(path, _declared_triangles(path))
    found = _read_polydata(path) if suffix == ".vtp" else _read_by_trimesh(path)
    require_triangles(path, found.mesh.faces, len(found.mesh.vertices_mm))
    require_few_triangles(path, len(found.mesh.faces))
    return found


def require_few_triangles(path: Path, count: int) -> None:
    """Refuse a scan of more triangles than any tooth needs.

    Raises:
        CaptureInputError: the scan has too many; the message says how many it has and how many are enough.
    """
    if count > MAX_TRIANGLES:
        raise CaptureInputError(
            f"Scan {path} has {count:,} triangles, more than {MAX_TRIANGLES:,}; "
            "reduce it to 500,000 or fewer in the scanner's program and export it again."
        )


def read_sidecar(path: Path) -> NDArray[np.float64]:
    """Read labels, (N,), from a file beside the scan: one number per line (.txt, .csv), an array (.npy), or the list
    ``labels`` of a .json file.

    Raises:
        CaptureInputError: the file is absent, of another format, or holds no list of numbers.
    """
    if not path.is_file():
        raise CaptureInputError(f"Label file {path} does not exist; put it there or correct its name.")
    try:
        if path.suffix.lower() == ".json":
            return _labels_of(parse_json(read_text(path, f"Label file {path}")))
        if path.suffix.lower() == ".npy":
            return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64).reshape(-1)
        return np.array(re.split(r"[\s,;]+", read_text(path, f"Label file {path}").strip()), dtype=np.float64)
    except (ValueError, KeyError, TypeError, EOFError) as problem:
        raise CaptureInputError(
            f"Label file {path} cannot be read ({problem}); give one number a line, an .npy array or a .json file with"
            " 'labels'."
        ) from problem


def _labels_of(tree: dict[str, Any]) -> NDArray[np.float64]:
    labels = np.asarray(tree["labels"])
    if labels.dtype.kind not in "iuf":
        raise ValueError("'labels' holds something else than numbers")
    return labels.astype(np.float64).reshape(-1)


def _declared_triangles(path: Path) -> int:
    # Number of triangles that the file's header declares, so that a file that is too large is refused before it is
    # read; 0 where the header does not tell.
    with path.open("rb") as file:
        head = file.read(PLY_HEAD_BYTES)
    if path.suffix.lower() == ".stl" and len(head) >= STL_HEADER_BYTES:
        count = int(struct.unpack_from("<I", head, 80)[0])
        whole = path.stat().st_size == STL_HEADER_BYTES + STL_TRIANGLE_BYTES * count
        return count if whole else 0
    if path.suffix.lower() == ".ply":
        words = head.partition(b"end_header")[0].split()
        counts = [words[k + 2] for k in range(len(words) - 2) if words[k : k + 2] == [b"element", b"face"]]
        return int(counts[0]) if counts and counts[0].isdigit() else 0
    return 0


def _read_polydata(path: Path) -> ScanFile:
    data = read_polydata(path)
    return ScanFile(Mesh(data.points, data.triangles), data.cell_arrays, {})


def _read_by_trimesh(path: Path) -> ScanFile:
    # Vertices and triangles keep the file's order, because a label file with one label for each relies on it.
    try:
        surface = read_surface(path)
        mesh, raw = Mesh(surface.vertices, surface.faces), surface.elements
        triangles, vertices = (_properties(raw[what]["data"]) if what in raw else {} for what in ("face", "vertex"))
    except Exception as problem:
        raise CaptureInputError(f"Mesh file {path} cannot be read ({problem}); export it again as PLY.") from problem
    return ScanFile(mesh, triangles, vertices)


def _properties(data: Any) -> dict[str, NDArray[Any]]:
    # Further properties of a PLY file's faces or vertices, which trimesh keeps in its raw data alone.
    names = data.dtype.names if isinstance(data, np.ndarray) else tuple(data)
    geometry = ("vertex_indices", "vertex_index", "x", "y", "z")
    return {name: np.asarray(data[name]).reshape(-1) for name in names if name not in geometry}
