"""A page that shows a raw folder's scan and one photograph of each camera; one file, which any browser opens offline.

The mouse rotates the scan. A click on the scan gives a point of its surface, and a click in a photograph gives its
pixel, which is not corrected for lens distortion. The page saves the clicked points as the ``[[landmark]]`` entries of
``raw.toml``.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.scans.patches import compact, vector_area_mm2
from services.anatomy.scans.units import MM_PER_UNIT
from services.calibrate.registration.overlay import displayed
from services.calibrate.registration.photographs import mean_photograph
from services.core.errors import CaptureInputError
from services.core.files.scans import read_scan_file
from services.core.geometry import Mesh
from services.core.pages.page import page_template
from services.core.raw.folder import read_raw_folder, scan_of
from services.core.raw.records import RawFolder
from services.core.store import write_atomic

PAGE = "landmarks.html"
SCRIPTS = ("photographs.js", "scan.js", "page.js")
WIDEST_PX = 1600
"""Largest width in pixels of a photograph in the page. Teeth that fill it are then resolved to 0.05 mm, a sixth of the
uncertainty of a click."""
JPEG_QUALITY = 90


def write_clicking_page(root: Path, out: Path | None = None) -> Path:
    """Write the page of a raw folder.

    Args:
        root: the folder of ``raw.toml``, which names a scan and has frames of the teeth.
        out: file to write; ``landmarks.html`` in the folder by default.

    Returns:
        The file that was written.

    Raises:
        CaptureInputError: the folder has no scan or no photograph of the teeth, or a file cannot be read.
    """
    folder = read_raw_folder(root)
    content = {
        "scan": _scan(root, folder),
        "photographs": [_photograph(root, folder, camera.name) for camera in folder.camera],
        "landmarks": [landmark.model_dump(mode="json") for landmark in folder.landmark],
    }
    here = Path(__file__).parent
    page = page_template(here / "page.html.j2").render(
        content=content,
        folder=root.resolve().name,
        style_of_page=(here / "page.css").read_text(encoding="utf-8"),
        script="\n".join((here / name).read_text(encoding="utf-8") for name in SCRIPTS),
    )
    path = root / PAGE if out is None else out
    write_atomic(path, page.encode())
    return path


def _scan(root: Path, folder: RawFolder) -> dict[str, Any]:
    scan = scan_of(root, folder)
    mesh = compact(read_scan_file(root / scan.file).mesh)
    mesh = Mesh(MM_PER_UNIT[scan.units] * mesh.vertices_mm, mesh.faces)
    if not (len(mesh.faces) and np.isfinite(mesh.vertices_mm).all()):
        raise CaptureInputError(f"Scan {scan.file} has no triangle, or vertices that are no numbers; export it again.")
    return {
        "file": scan.file,
        "vertices": _packed(mesh.vertices_mm.astype("<f4")),
        "faces": _packed(mesh.faces.astype("<u4")),
        "turn": _towards_the_chewing_side(mesh).tolist(),
    }


def _towards_the_chewing_side(mesh: Mesh) -> NDArray[np.float64]:
    # The rows are the directions right, up and towards a viewer who looks at the side opposite to the surface's
    # opening.
    away = vector_area_mm2(mesh)
    if not np.linalg.norm(away) > 0:
        return np.eye(3)
    away = away / np.linalg.norm(away)
    places = mesh.vertices_mm - mesh.vertices_mm.mean(axis=0)
    flat = places - np.outer(places @ away, away)
    across = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    return np.stack([across, np.cross(away, across), away])


def _photograph(root: Path, folder: RawFolder, camera: str) -> dict[str, Any]:
    import cv2

    picture = displayed(mean_photograph(root, folder, camera))
    width, height = folder.camera_named(camera).size
    scale = min(1.0, WIDEST_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture
    jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return {"camera": camera, "size": [width, height], "jpeg": _packed(jpeg)}


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
