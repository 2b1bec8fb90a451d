"""A small labelled scan, steep bumps on a plate like teeth in gums, and writers of the file formats of scans."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.scan import LabelledScan
from services.core.geometry import Mesh

PITCH_MM = 0.4
CROWN_MM = 7.0
RADIUS_MM = 3.6
NECK_MM = 1.0
"""Height above the plate from which a bump is labelled as a tooth."""


def bumps(places_mm: dict[int, tuple[float, float]]) -> LabelledScan:
    """One bump per FDI number on a rectangular plate in the plane z = 0, z occlusal."""
    middles = np.array(list(places_mm.values()))
    low, high = middles.min(axis=0) - 7.0, middles.max(axis=0) + 7.0
    nx, ny = np.ceil((high - low) / PITCH_MM).astype(int) + 1
    x, y = np.meshgrid(low[0] + PITCH_MM * np.arange(nx), low[1] + PITCH_MM * np.arange(ny), indexing="ij")
    heights = np.stack([CROWN_MM * np.exp(-((np.hypot(x - a, y - b) / RADIUS_MM) ** 6)) for a, b in middles])
    vertices = np.stack([x, y, heights.max(axis=0)], axis=-1).reshape(-1, 3)
    i, j = (index.reshape(-1) for index in np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij"))
    a, b, c, d = i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32)
    over = heights.reshape(len(middles), -1)[:, faces].mean(axis=-1)
    labels = np.where(over.max(axis=0) > NECK_MM, np.array(list(places_mm))[over.argmax(axis=0)], 0)
    return LabelledScan(Mesh(vertices, faces), labels.astype(np.int64))


def universal(fdi: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert FDI numbers of upper teeth to Universal numbers; 0 (gums) stays 0."""
    return np.where(fdi == 0, 0, np.where(fdi < 20, 19 - fdi, fdi - 12))


def write_vtp(
    path: Path,
    mesh: Mesh,
    labels: NDArray[np.int64] | None,
    *,
    form: str = "appended-base64",
    compressed: bool = True,
    header_type: str = "UInt32",
    joined: bool = False,
    byte_order: str = "LittleEndian",
) -> None:
    """Write VTK PolyData in one of the encodings that programs use; ``joined`` encodes header and data as one base64
    stream.
    """
    order: Literal["<", ">"] = "<" if byte_order == "LittleEndian" else ">"
    width = {"UInt32": "u4", "UInt64": "u8"}[header_type]
    payload = b""

    def encode(values: NDArray[np.generic]) -> bytes:
        raw = values.astype(values.dtype.newbyteorder(order)).tobytes()
        if compressed:
            half = 1000
            blocks = [raw[k : k + half] for k in range(0, len(raw), half)]
            packed = [zlib.compress(block) for block in blocks]
            head = np.array([len(blocks), half, len(blocks[-1]), *map(len, packed)], dtype=order + width).tobytes()
            body = b"".join(packed)
        else:
            head, body = np.array([len(raw)], dtype=order + width).tobytes(), raw
        if form == "appended-raw":
            return head + body
        return base64.b64encode(head + body) if joined else base64.b64encode(head) + base64.b64encode(body)

    def array(name: str, kind: str, values: NDArray[np.generic], columns: int = 1) -> str:
        nonlocal payload
        opening = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{columns}"'
        if form == "ascii":
            return f'{opening} format="ascii">{" ".join(str(v) for v in values.reshape(-1).tolist())}</DataArray>'
        if form == "inline":
            return f'{opening} format="binary">\n{encode(values.reshape(-1)).decode()}\n</DataArray>'
        offset = len(payload)
        payload += encode(values.reshape(-1))
        return f'{opening} format="appended" offset="{offset}"/>'

    cells = "" if labels is None else array("Label", "Float32", labels.astype(np.float32))
    points = array("Points", "Float64", mesh.vertices_mm, 3)
    connectivity = array("connectivity", "Int64", mesh.faces.astype(np.int64))
    offsets = array("offsets", "Int64", 3 * np.arange(1, len(mesh.faces) + 1, dtype=np.int64))
    compressor = ' compressor="vtkZLibDataCompressor"' if compressed else ""
    head = (
        f'<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="{byte_order}"'
        f' header_type="{header_type}"{compressor}><PolyData>'
        f'<Piece NumberOfPoints="{len(mesh.vertices_mm)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0"'
        f' NumberOfPolys="{len(mesh.faces)}">'
        f"<CellData>{cells}</CellData><Points>{points}</Points><Polys>{connectivity}{offsets}</Polys></Piece></PolyData>"
    )
    appended = b""
    if form.startswith("appended"):
        appended = f'<AppendedData encoding="{form.split("-")[1]}">\n_'.encode() + payload + b"\n</AppendedData>"
    path.write_bytes(head.encode() + appended + b"</VTKFile>\n")


def write_labelled_ply(path: Path, mesh: Mesh, labels: NDArray[np.int64]) -> None:
    """Write an ASCII PLY file with a label per face."""
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(mesh.vertices_mm)}",
        *(f"property double {axis}" for axis in "xyz"),
    ]
    lines += [
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
        "property int label",
        "end_header",
    ]
    lines += [" ".join(map(repr, row)) for row in mesh.vertices_mm.tolist()]
    lines += [f"3 {a} {b} {c} {label}" for (a, b, c), label in zip(mesh.faces.tolist(), labels.tolist(), strict=True)]
    path.write_text("\n".join(lines) + "\n")
