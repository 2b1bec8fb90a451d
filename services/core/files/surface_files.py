"""Read the vertices and triangles of a PLY, STL or OBJ file in the file's own order.

trimesh parses PLY and STL. It sorts the triangles of an OBJ file by material and object and counts relative indices
from each object, so the ``v`` and ``f`` lines of OBJ are read here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError

_INDEX_NAMES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) and triangles (F, 3) of a file, and the further data of a PLY file's elements by their names."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    elements: Mapping[str, Any] = field(default_factory=dict)


def require_file(path: Path) -> None:
    """Refuse a mesh file that is absent.

    Raises:
        CaptureInputError: no file is there.
    """
    if not path.is_file():
        raise CaptureInputError(f"Mesh file {path} does not exist; put the exported mesh there.")


def require_triangles(path: Path, faces: NDArray[np.integer[Any]], vertices: int) -> None:
    """Refuse the triangles (F, 3) of a file of so many vertices where there are none, or where a corner is no vertex.

    Raises:
        CaptureInputError: the message names the file.
    """
    if len(faces) == 0:
        raise CaptureInputError(f"Mesh file {path} holds no triangle; export the surface, not a point cloud.")
    if faces.min() < 0 or faces.max() >= vertices:
        raise CaptureInputError(f"Mesh file {path} has a triangle of points that it does not hold; export it again.")


def read_surface(path: Path) -> Surface:
    """Read a surface; no vertices are merged, no faces are flipped, and polygons become triangles around their first
    corner.

    Raises:
        ValueError, and any error of the parser: the file is damaged; the message says how.
    """
    if path.suffix.lower() == ".obj":
        return _read_obj(path)
    import trimesh

    loaded = trimesh.load_mesh(path, process=False)
    faces = np.asarray(loaded.faces, dtype=np.int32)
    elements = loaded.metadata.get("_ply_raw", {}) if path.suffix.lower() == ".ply" else {}
    if len(faces) and elements:
        _require_whole_indices(path, elements)
    return Surface(np.asarray(loaded.vertices, dtype=np.float64), faces, elements)


def _read_obj(path: Path) -> Surface:
    vertices, faces = list[Sequence[float]](), list[tuple[int, int, int]]()
    for number, words in _lines(path):
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                vertices.append((float(x), float(y), float(z)))
            elif words[0] == "f":
                first, *others = _corners(words[1:], len(vertices))
                faces += [(first, second, third) for second, third in pairwise(others)]
        except ValueError as problem:
            raise ValueError(f"line {number}: {problem}") from problem
    found = np.array(faces, dtype=np.int64).reshape(-1, 3)
    if len(found) and found.max() >= len(vertices):
        raise ValueError(f"a face names vertex {found.max() + 1} of {len(vertices)}")
    return Surface(np.array(vertices, dtype=np.float64).reshape(-1, 3), found.astype(np.int32))


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines of an OBJ file; a backslash joins a line with the next one."""
    joined = ""
    with path.open(encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            text = line.partition("#")[0].rstrip()
            if text.endswith("\\"):
                joined += f"{text[:-1]} "
                continue
            if words := (joined + text).split():
                yield number, words
            joined = ""
    if words := joined.split():
        yield number, words


def _corners(words: Sequence[str], known: int) -> list[int]:
    if len(words) < 3:
        raise ValueError("a face has fewer than three corners")
    return [_vertex(word, known) for word in words]


def _vertex(word: str, known: int) -> int:
    """Index from 0 of the vertex that a face's corner names; a negative one counts back from the last vertex."""
    index = int(word.partition("/")[0])
    if index == 0 or -index > known:
        raise ValueError(f"a face names vertex {index}, and vertices are counted from 1")
    return index - 1 if index > 0 else known + index


def _require_whole_indices(path: Path, elements: Mapping[str, Any]) -> None:
    """Refuse a PLY file whose faces have fractional indices, or lists of another length than they state."""
    face = elements["face"]
    name = next((one for one in _INDEX_NAMES if one in face["properties"]), None)
    if name is None:
        raise ValueError("its faces have no list of vertices")
    if face["properties"][name].rpartition(")")[2].lstrip("<>").startswith("f"):
        raise ValueError("its faces name vertices by numbers that are not whole")
    if isinstance(face["data"], np.ndarray):
        lists = face["data"][name]
        wrong = np.flatnonzero(lists["f0"] != lists["f1"].shape[-1])
        if len(wrong):
            raise ValueError(
                f"face {wrong[0] + 1} states {lists['f0'][wrong[0]]} corners and the first one {lists['f1'].shape[-1]}"
            )
    elif next(iter(face["properties"])) == name:
        _require_whole_words(path, elements)


def _require_whole_words(path: Path, elements: Mapping[str, Any]) -> None:
    body = path.read_text(encoding="utf-8", errors="replace").partition("end_header")[2].partition("\n")[2]
    lines, first = body.splitlines(), 0
    for name, element in elements.items():
        if name == "face":
            break
        first += element["length"]
    for number, line in enumerate(lines[first : first + elements["face"]["length"]], 1):
        stated, *words = line.split()
        corners = int(stated)
        if corners < 3 or len(words) < corners:
            raise ValueError(f"face {number} states {corners} corners and has {len(words)} numbers")
        for word in words[:corners]:
            if not word.isdecimal():
                raise ValueError(f"face {number} names vertex {word}, and vertices are whole numbers from 0")
