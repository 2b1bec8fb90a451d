"""A labelled intra-oral scan: one open surface of one jaw, whose every triangle is of a tooth or of the gingiva."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError, InputError
from services.core.files.meshes import read_labelled_mesh
from services.core.geometry import Mesh

Numbering = Literal["universal", "fdi"]

GINGIVA = 0
EXTENT_MM = (8.0, 200.0)
"""Of a scan with two teeth at least."""


@dataclass(frozen=True)
class LabelledScan:
    """An open surface, counter-clockwise seen from outside the tissue, and the FDI number of each face (F,), 0 for gingiva."""

    mesh: Mesh
    fdi: NDArray[np.int64]

    @property
    def teeth(self) -> tuple[int, ...]:
        """FDI numbers that occur, ascending."""
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


def read_scan(path: Path, numbering: Numbering = "universal", array: str = "Label") -> LabelledScan:
    """Read a VTK PolyData file (.vtp) with a cell array of labels, or a PLY file with a face property of labels; mm.

    Args:
        numbering: how labels name teeth; 0 is gingiva in either.
        array: name of the cell array or face property.

    Raises:
        CaptureInputError: unreadable, without labels, with labels that name no tooth, without gingiva, or not of one jaw. MeshError: not in millimetres.
    """
    mesh, arrays = read_labelled_mesh(path)
    found = next((values for name, values in arrays.items() if name.lower() == array.lower()), None)
    if found is None:
        held = ", ".join(sorted(arrays)) or "none"
        raise CaptureInputError(
            f"Scan {path} has no label per triangle named {array} (it has: {held}); export it with its segmentation."
        )
    values = np.asarray(found, dtype=np.float64)
    if values.shape != (len(mesh.faces),):
        raise CaptureInputError(
            f"Scan {path} has labels {array} of shape {values.shape} for {len(mesh.faces)} triangles; export one label per triangle."
        )
    mesh.require_surface(f"of scan {path}", EXTENT_MM)
    scan = LabelledScan(mesh, _fdi_numbers(values, numbering, path))
    if not (scan.fdi == GINGIVA).any():
        raise CaptureInputError(
            f"Scan {path} has no gingiva (label {GINGIVA}); export it with the gums around the teeth."
        )
    if len(scan.teeth) < 2:
        raise CaptureInputError(
            f"Scan {path} has {len(scan.teeth)} labelled teeth; export at least two, which tell left from right."
        )
    if len({number // 10 in (1, 2) for number in scan.teeth}) > 1:
        raise CaptureInputError(
            f"Scan {path} has teeth of both jaws ({', '.join(map(str, scan.teeth))}); export each jaw alone, or mend the labels."
        )
    return scan


def _fdi_numbers(values: NDArray[np.float64], numbering: Numbering, path: Path) -> NDArray[np.int64]:
    names = {fdi_from_universal(n): n for n in range(1, 33)}
    number_of = {float(GINGIVA): GINGIVA} | {
        float(n if numbering == "universal" else fdi): fdi for fdi, n in names.items()
    }
    labels, index = np.unique(values, return_inverse=True)
    unknown = [f"{label:g}" for label in labels if float(label) not in number_of]
    if unknown:
        expected = "1 to 32" if numbering == "universal" else "11 to 48"
        raise CaptureInputError(
            f"Scan {path} has label {unknown[0]}, which names no tooth in {numbering} numbering; give {GINGIVA} for gingiva, {expected} for teeth."
        )
    return np.array([number_of[float(label)] for label in labels], dtype=np.int64)[index.reshape(-1)]
