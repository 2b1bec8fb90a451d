"""Good files of every format that is read, mutations of them, and second parsers to compare with.

A mutation changes a tag, a header, a window, an index, an encoding or single bytes. A reader may refuse the result in a
sentence, or must read the same as the second parser.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import tifffile
import trimesh
from numpy.typing import NDArray
from PIL import Image

from services.calibrate.colour.chart import read_reference
from services.core.errors import DentineError
from services.core.files.meshes import read_mesh
from services.core.raw.decoding import decode

Array = NDArray[Any]
Random = np.random.Generator
ADDED_BYTES = b"\0\1\2\3\7\x0f\x7f\x80\xff"
"""Values that a mutated byte takes."""


@dataclass(frozen=True)
class Outcome:
    """What became of one mutated file: ``same``, ``refused``, ``unread`` (the second parser cannot read it either), or
    a fault: ``differs`` or ``traceback``.
    """

    name: str
    kind: str
    detail: str = ""

    @property
    def is_fault(self) -> bool:
        """Whether the reader was wrong in silence, or failed without a sentence."""
        return self.kind in {"differs", "traceback"}


@dataclass(frozen=True)
class Format:
    """A file format: how a good file is made, and how the project and a second parser read it."""

    suffix: str
    good: Callable[[Random, Path], None]
    ours: Callable[[Path], Array]
    theirs: Callable[[Path], Array | None]
    header_bytes: int
    """Number of bytes at the beginning in which half of the mutations fall."""


def _counts(random: Random, channels: int) -> Array:
    shape = (24, 32) if channels == 1 else (24, 32, channels)
    return random.integers(0, 4000, shape).astype(np.uint16)


def _write_tiff(random: Random, path: Path) -> None:
    channels = int(random.integers(1, 3) * 2 - 1)
    tifffile.imwrite(
        path,
        _counts(random, channels),
        photometric="minisblack" if channels == 1 else "rgb",
        byteorder="<>"[random.integers(2)],
        compression=[None, "zlib"][random.integers(2)],
        rowsperstrip=int(random.integers(4, 25)),
        metadata=None,
    )


def _write_png(random: Random, path: Path) -> None:
    cv2.imwrite(str(path), _counts(random, int(random.integers(1, 3) * 2 - 1)))


def _write_npy(random: Random, path: Path) -> None:
    np.save(path, _counts(random, 3))


def _write_exr(random: Random, path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": _counts(random, 3).astype(np.float32)}) as file:
        file.write(str(path))


def _write_obj(random: Random, path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=float(random.uniform(2, 9)))
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in ball.vertices]
    path.write_text("\n".join([*lines, *("f " + " ".join(map(str, face + 1)) for face in ball.faces)]) + "\n")


def _write_ply(random: Random, path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=float(random.uniform(2, 9)))
    path.write_bytes(ball.export(file_type="ply", encoding=["ascii", "binary"][random.integers(2)]))


def _write_csv(random: Random, path: Path) -> None:
    xyz = random.uniform(5, 60, (24, 3))
    xyz[18:] = np.array([90.0, 59, 36, 20, 9, 3])[:, None] * (0.9642, 1, 0.8251)
    separator = [",", ";", "\t"][random.integers(3)]
    text = "\n".join(separator.join(map(str, row)) for row in ["XYZ", *np.round(xyz, 3)]) + "\n"
    path.write_bytes(text.encode(["utf-8", "utf-8-sig", "utf-16"][random.integers(3)]))


def _pillow(path: Path) -> Array | None:
    with Image.open(path) as image:
        if getattr(image, "n_frames", 1) != 1 or image.mode not in {"L", "I;16", "I;16B", "I;16L", "RGB"}:
            return None
        if image.mode == "RGB":  # of 16 bits, which Pillow reduces to 8
            return _opencv(path)
        found = np.asarray(image)
    return found.astype(found.dtype.newbyteorder("="))


def _opencv(path: Path) -> Array | None:
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return None if found is None else found[..., ::-1] if found.ndim == 3 else found


def _numpy_by_hand(path: Path) -> Array | None:
    content = path.read_bytes()
    (length,) = struct.unpack_from("<H", content, 8)
    header = eval(content[10 : 10 + length], {"__builtins__": {}})
    array = np.frombuffer(content[10 + length :], dtype=np.dtype(header["descr"]), count=int(np.prod(header["shape"])))
    return array.reshape(header["shape"], order="F" if header["fortran_order"] else "C").astype(
        array.dtype.newbyteorder("=")
    )


def _exr_by_hand(path: Path) -> Array | None:
    """Scan lines of an EXR packed by ZIPS, decoded by zlib (OpenEXR, Technical Introduction)."""
    from services.core.files.image_headers import exr_parts

    content = path.read_bytes()
    (header,) = exr_parts(content)
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    sx, sy, ex, ey = struct.unpack("<4i", header["displayWindow"])
    if header["compression"] != b"\x02" or (right - left, bottom - top) != (31, 23):
        return None
    data = np.zeros((24, 32, 3), np.float32)
    place = _end_of_header(content)
    for offset in struct.unpack_from("<24Q", content, place):
        line, size = struct.unpack_from("<ii", content, offset)
        packed = content[offset + 8 : offset + 8 + size]
        if size < 384:
            raw = np.frombuffer(zlib.decompress(packed), np.uint8).astype(np.int64)
            raw = (np.cumsum(np.concatenate([raw[:1], raw[1:] - 128])) % 256).astype(np.uint8)
            plain = np.empty(384, np.uint8)
            plain[::2], plain[1::2] = raw[:192], raw[192:]
            packed = plain.tobytes()
        data[line - top] = np.frombuffer(packed, "<f4").reshape(3, 32).T
    whole = np.zeros((ey - sy + 1, ex - sx + 1, 3), np.float32)
    rows, columns = np.mgrid[top : bottom + 1, left : right + 1]
    seen = (rows >= sy) & (rows <= ey) & (columns >= sx) & (columns <= ex)
    whole[(rows - sy)[seen], (columns - sx)[seen]] = data[seen]
    return whole


def _end_of_header(content: bytes) -> int:
    place = 8
    while content[place] != 0:
        place = content.index(0, content.index(0, place) + 1) + 1
        place += 4 + struct.unpack_from("<i", content, place)[0]
    return place + 1


def _corners(vertices: Array, faces: Array) -> Array:
    return np.asarray(vertices, dtype=np.float64)[np.asarray(faces, dtype=np.int64)]


def _our_mesh(path: Path) -> Array:
    mesh = read_mesh(path)
    return _corners(mesh.vertices_mm, mesh.faces)


def _obj_by_hand(path: Path) -> Array | None:
    vertices, faces = list[list[float]](), list[list[int]]()
    for line in path.read_bytes().decode("utf-8", "replace").split("\n"):
        words = line.split("#")[0].split()
        if words[:1] == ["v"]:
            vertices.append([float(one) for one in words[1:4]])
        elif words[:1] == ["f"]:
            numbers = [int(one.split("/")[0]) for one in words[1:]]
            numbers = [one - 1 if one > 0 else len(vertices) + one for one in numbers]
            faces += [[numbers[0], *numbers[k : k + 2]] for k in range(1, len(numbers) - 1)]
    return _corners(np.array(vertices), np.array(faces))


def _meshlab(path: Path) -> Array | None:
    """A PLY as its header declares it, read with NumPy."""
    content = path.read_bytes()
    head, _, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    count = {line[1]: int(line[2]) for line in lines if line[:1] == ["element"]}
    types = [line for line in lines if line[:1] == ["property"]]
    if [one[1:] for one in types] != [
        ["float", "x"],
        ["float", "y"],
        ["float", "z"],
        ["list", "uchar", "int", "vertex_indices"],
    ]:
        return None
    if ["format", "ascii", "1.0"] in lines:
        rows = [line.split() for line in body.decode("ascii").splitlines()]
        vertices = np.array(rows[: count["vertex"]], dtype=np.float32)
        faces = np.array(rows[count["vertex"] :][: count["face"]], dtype=np.int64)
    else:
        order = "<" if ["format", "binary_little_endian", "1.0"] in lines else ">"
        vertices = np.frombuffer(body, f"{order}f4", 3 * count["vertex"]).reshape(-1, 3)
        listed = np.dtype([("n", "u1"), ("i", f"{order}i4", 3)])
        found = np.frombuffer(body, listed, count["face"], offset=vertices.nbytes)
        faces = np.column_stack([found["n"].astype(np.int64), found["i"].astype(np.int64)])
    if (faces[:, 0] != 3).any() or faces[:, 1:].min() < 0:
        return None
    return _corners(vertices, faces[:, 1:])


def _csv_by_hand(path: Path) -> Array | None:
    content = path.read_bytes()
    text = content.decode("utf-16" if content[:2] in {b"\xff\xfe", b"\xfe\xff"} else "utf-8-sig")
    lines = [line for line in io.StringIO(text).read().replace("\r", "\n").split("\n") if line.strip()]
    separator = next((one for one in ";\t," if one in lines[0]), ",")
    head = [cell.strip().upper() for cell in lines[0].split(separator)]
    rows = [[cell.strip() for cell in line.split(separator)] for line in lines[1:] if not line.startswith("#")]
    return np.array([[float(row[head.index(axis)]) for axis in "XYZ"] for row in rows]) / 100


def _values(path: Path) -> Array:
    decoded = decode(path)
    values = np.asarray(decoded.values)
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "tiff": Format(".tif", _write_tiff, _values, _pillow, 320),
        "png": Format(".png", _write_png, _values, _opencv, 60),
        "npy": Format(".npy", _write_npy, _values, _numpy_by_hand, 128),
        "exr": Format(".exr", _write_exr, _values, _exr_by_hand, 320),
        "obj": Format(".obj", _write_obj, _our_mesh, _obj_by_hand, 2000),
        "ply": Format(".ply", _write_ply, _our_mesh, _meshlab, 300),
        "csv": Format(".csv", _write_csv, lambda path: read_reference(path, "c"), _csv_by_hand, 200),
    }
)


def mutated(content: bytes, random: Random, header_bytes: int) -> bytes:
    """Change one to three places: a byte, a 16-bit number, a cut, a doubled or a lost piece."""
    changed = bytearray(content)
    for _ in range(random.integers(1, 4)):
        limit = min(header_bytes, len(changed)) if random.random() < 0.7 else len(changed)
        place = int(random.integers(0, max(limit, 1)))
        how = random.integers(5)
        if how <= 1:
            changed[place] = (
                int(random.choice(list(ADDED_BYTES))) if how else changed[place] ^ (1 << random.integers(8))
            )
        elif how == 2:
            changed[place : place + 2] = struct.pack("<H", int(random.choice([0, 1, 2, 3, 5, 8, 255, 32803])))
        elif how == 3:
            piece = changed[place : place + int(random.integers(1, 12))]
            changed[place:place] = piece
        else:
            del changed[place : place + int(random.integers(1, 12))]
    return bytes(changed)


def with_right_checksums(content: bytes) -> bytes:
    """A PNG whose parts have the checksums of their content, so that a changed header is not found by them alone."""
    fixed, place = bytearray(content), 8
    while place + 12 <= len(fixed):
        length = int.from_bytes(fixed[place : place + 4], "big")
        if place + 12 + length > len(fixed):
            break
        crc = zlib.crc32(bytes(fixed[place + 4 : place + 8 + length]))
        fixed[place + 8 + length : place + 12 + length] = struct.pack(">I", crc)
        place += 12 + length
    return bytes(fixed)


def tried(name: str, kind: Format, content: bytes, path: Path) -> Outcome:
    """Read one mutated file with the project and with the second parser."""
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ours = kind.ours(path)
    except DentineError as problem:
        return Outcome(name, "refused", problem.message)
    except ValueError as problem:  # of ``decode``, whose messages are parts of a sentence with a remedy
        return Outcome(name, "refused" if "; " in str(problem) else "traceback", repr(problem))
    except Exception as problem:  # any other error is a fault of the reader, which is what is looked for
        return Outcome(name, "traceback", repr(problem))
    try:
        theirs = kind.theirs(path)
    except Exception as problem:  # the second parser need not be kind
        return Outcome(name, "unread", repr(problem))
    if theirs is None:
        return Outcome(name, "unread")
    if ours.shape != theirs.shape or not np.allclose(ours, theirs, rtol=1e-6, atol=1e-6, equal_nan=True):
        return Outcome(name, "differs", f"{ours.shape} {ours.dtype} and {theirs.shape} {theirs.dtype}")
    return Outcome(name, "same")


def outcomes(name: str, count: int, seed: int, folder: Path) -> list[Outcome]:
    """Mutate ``count`` good files of a format and read each."""
    kind, random = FORMATS[name], np.random.default_rng([seed, *name.encode()])
    found = []
    for number in range(count):
        path = folder / f"{number}{kind.suffix}"
        kind.good(random, path)
        content = path.read_bytes()
        if number % 10:
            content = mutated(content, random, kind.header_bytes)
        if name == "png":
            content = with_right_checksums(content)
        found.append(tried(f"{name} {number}", kind, content, path))
        if not found[-1].is_fault:
            path.unlink()
    return found
