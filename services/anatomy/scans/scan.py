"""An intra-oral scan: one open surface of one jaw, in which labels or landmarks assign each triangle to a tooth or to
the gingiva.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.order import require_order
from services.anatomy.scans.patches import compact, middle_mm
from services.anatomy.scans.segmentation import GINGIVA, segment_by_landmarks
from services.anatomy.scans.units import MM_PER_UNIT, Unit, require_anatomical_scale
from services.anatomy.templates.average_arch import is_upper
from services.core.errors import CaptureInputError, InputError
from services.core.files.scans import SIDECARS, ScanFile, read_scan_file, read_sidecar
from services.core.geometry import Mesh

Numbering = Literal["universal", "fdi", "either"]
"""Numbering of the labels. ``either`` means FDI numbers if all labels are FDI numbers, and either all name one jaw or
one exceeds the Universal numbers; else Universal numbers."""
Jaw = Literal["upper", "lower"]

LABEL = "Label"
"""Default name of the array of labels."""
HIGHEST_UNIVERSAL = 32
"""Largest number of a permanent tooth in Universal Numbering."""
EXTENT_MM = (8.0, 200.0)
"""Smallest and largest extent of a scan with at least two teeth, mm."""


@dataclass(frozen=True)
class LabelledScan:
    """An open surface with an FDI number for each face."""

    mesh: Mesh
    """Surface whose triangles are counter-clockwise seen from outside the tissue."""
    fdi: NDArray[np.int64]
    """FDI number (F,) of each face; 0 for gingiva."""
    doubled_vertices: int = 0
    """Number of vertices of the file that were copies of others and were joined with them."""
    unused_vertices: int = 0
    """Number of vertices that no triangle uses and that were dropped."""
    is_labelled: bool = True
    """Whether the numbers are labels of the file; otherwise they follow from points on the teeth."""

    @property
    def teeth(self) -> tuple[int, ...]:
        """FDI numbers of the scan's teeth, ascending."""
        return tuple(int(number) for number in np.unique(self.fdi) if number != GINGIVA)


def fdi_from_universal(number: int) -> int:
    """FDI (ISO 3950) number of a permanent tooth 1 to 32 of the Universal Numbering System.

    Raises:
        InputError: there is no such tooth.
    """
    if not 1 <= number <= 32:
        raise InputError(f"Universal Numbering has no tooth {number}; permanent teeth are 1 to 32.")
    quadrant, place = divmod(number - 1, 8)
    return 10 * (quadrant + 1) + (8 - place if quadrant % 2 == 0 else place + 1)


def read_scan(
    path: Path,
    numbering: Numbering = "universal",
    labels: str | None = LABEL,
    *,
    units: Unit = "mm",
    jaw: Jaw | None = None,
    points_mm: Mapping[int, NDArray[np.float64]] | None = None,
) -> LabelledScan:
    """Read a scan (.vtp, .ply, .stl or .obj) with a label for each triangle or each vertex, or with points on its
    teeth.

    Args:
        path: file of the scan.
        numbering: numbering of the labels; 0 is gingiva in all of them.
        labels: name of the file's array or property, or of a file beside the scan (.json, .npy, .txt, .csv), which
            formats without properties need. None: the array named Label if the file has one, else no labels.
        units: unit of the file's coordinates.
        jaw: jaw that the scan is expected to show; None for either.
        points_mm: by FDI number, points (N, 3) in mm on the tooth, by which a scan without labels is segmented.

    Raises:
        CaptureInputError: the scan is unreadable, lacks labels or gingiva, has labels that name no tooth, or is not of
            one jaw or of the expected one.
        MeshError: the scan has a size that no jaw has in this unit, or its teeth stand in another order than their
            numbers.
    """
    file = read_scan_file(path)
    is_labelled = labels is not None or _array(file, LABEL) is not None
    values = _triangle_labels(file, path, labels or LABEL) if is_labelled else None
    mesh, doubled = _welded(file.mesh)
    whole, mesh = len(mesh.vertices_mm), compact(mesh)
    mesh = Mesh(MM_PER_UNIT[units] * mesh.vertices_mm, mesh.faces)
    if values is None:
        mesh.require_surface(f"of scan {path}", EXTENT_MM)
        fdi = segment_by_landmarks(mesh, points_mm or {}, f"scan {path}")
    else:
        fdi = _fdi_numbers(values, numbering, path)
    scan = LabelledScan(mesh, fdi, doubled, whole - len(mesh.vertices_mm), is_labelled)
    _require_one_jaw(scan, path, jaw)
    if np.isfinite(mesh.vertices_mm).all():
        middles = [middle_mm(Mesh(mesh.vertices_mm, mesh.faces[scan.fdi == number])) for number in scan.teeth]
        require_order(scan.teeth, np.array(middles), f"scan {path}")
        require_anatomical_scale(scan.teeth, np.array(middles), units, f"scan {path}")
    mesh.require_surface(f"of scan {path}", EXTENT_MM)
    return scan


def _require_one_jaw(scan: LabelledScan, path: Path, jaw: Jaw | None) -> None:
    if not (scan.fdi == GINGIVA).any():
        raise CaptureInputError(
            f"Scan {path} has no gingiva (label {GINGIVA}); export it with the gums around the teeth."
        )
    if len(scan.teeth) < 2:
        raise CaptureInputError(
            f"Scan {path} has {len(scan.teeth)} labelled teeth; export at least two, which tell left from right."
        )
    if len({is_upper(number) for number in scan.teeth}) > 1:
        raise CaptureInputError(
            f"Scan {path} has teeth of both jaws ({', '.join(map(str, scan.teeth))}); export each jaw alone, or mend"
            " the labels."
        )
    found = "upper" if is_upper(scan.teeth[0]) else "lower"
    if jaw is not None and jaw != found:
        raise CaptureInputError(
            f"Scan {path} is said to be of the {jaw} jaw, but its labels name teeth of the {found} one "
            f"({', '.join(map(str, scan.teeth))}); correct jaw in [scan], or give the other scan."
        )


def _triangle_labels(file: ScanFile, path: Path, labels: str) -> NDArray[np.float64]:
    # Labels (F,) of the triangles, from the scan's file or from a file beside it.
    if Path(labels).suffix.lower() in SIDECARS:
        sidecar = path.parent / labels
        return _per_triangle(read_sidecar(sidecar), file, f"Label file {sidecar}")
    found = _array(file, labels)
    if found is not None:
        return _per_triangle(np.asarray(found, dtype=np.float64), file, f"Scan {path}, array {labels},")
    available = ", ".join(sorted(file.triangle_arrays | file.vertex_arrays)) or "none"
    raise CaptureInputError(
        f"Scan {path} has no label per triangle named {labels} (it has: {available}); export it with its segmentation, "
        "or name a file of labels beside it (.json, .npy, .txt, .csv)."
    )


def _array(file: ScanFile, name: str) -> NDArray[Any] | None:
    # Array with a name, in upper or lower case; arrays of triangles take precedence over those of vertices.
    for arrays in (file.triangle_arrays, file.vertex_arrays):
        for own, values in arrays.items():
            if own.lower() == name.lower():
                return values
    return None


def _per_triangle(values: NDArray[np.float64], file: ScanFile, what: str) -> NDArray[np.float64]:
    triangles, vertices = len(file.mesh.faces), len(file.mesh.vertices_mm)
    if values.shape == (triangles,):
        return values
    if values.shape == (vertices,):
        # Take the label that two of the corners share; of three different labels take the first.
        one, two, three = (values[file.mesh.faces[:, k]] for k in range(3))
        return np.asarray(np.where(two == three, two, one))
    raise CaptureInputError(
        f"{what} has labels of shape {values.shape} for {triangles} triangles and {vertices} vertices; export one a"
        " triangle."
    )


def _welded(mesh: Mesh) -> tuple[Mesh, int]:
    # Join vertices at the same place, which an STL file repeats about six times. Compare them in single precision, in
    # which scanners write.
    joined, first, index = np.unique(
        mesh.vertices_mm.astype(np.float32), axis=0, return_index=True, return_inverse=True
    )
    doubled = len(mesh.vertices_mm) - len(joined)
    if doubled == 0:
        return mesh, 0
    # Keep the order of the file.
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return Mesh(mesh.vertices_mm[first[order]], rank[index.reshape(-1)][mesh.faces].astype(np.int32)), doubled


def _fdi_numbers(values: NDArray[np.float64], numbering: Numbering, path: Path) -> NDArray[np.int64]:
    names = {fdi_from_universal(n): n for n in range(1, 33)}
    labels, index = np.unique(values, return_inverse=True)
    if numbering == "either":
        numbering = "fdi" if _are_fdi(labels, frozenset(names)) else "universal"
    number_of = {float(GINGIVA): GINGIVA} | {
        float(n if numbering == "universal" else fdi): fdi for fdi, n in names.items()
    }
    unknown = [f"{label:g}" for label in labels if float(label) not in number_of]
    if unknown:
        expected = "1 to 32" if numbering == "universal" else "11 to 48"
        raise CaptureInputError(
            f"Scan {path} has label {unknown[0]}, which names no tooth in {numbering} numbering; give {GINGIVA} for"
            f" gingiva, {expected} for teeth."
        )
    return np.array([number_of[float(label)] for label in labels], dtype=np.int64)[index.reshape(-1)]


def _are_fdi(labels: NDArray[np.float64], fdi: frozenset[int]) -> bool:
    # Whether all labels are FDI numbers, and name teeth of one jaw or a tooth that Universal Numbering does not have.
    teeth = [float(label) for label in labels if label != GINGIVA]
    return all(label in fdi for label in teeth) and (
        len({is_upper(int(label)) for label in teeth}) <= 1 or max(teeth) > HIGHEST_UNIVERSAL
    )
