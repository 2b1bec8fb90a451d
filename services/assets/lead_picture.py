"""The picture with which a report begins, and its differences in colour, written into the asset: photographs beside
renders of it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from services.assets.appearance.differences import ColourDifference, colour_difference
from services.assets.appearance.white import CameraWhite
from services.assets.asset import middle_of
from services.assets.colour.beside import Beside, Pair, Shown, beside, square_means
from services.assets.colour.beside_picture import picture
from services.assets.fitted_job import FittedJob
from services.assets.provenance.departing import BESIDE_PHOTOGRAPH, COLOUR_DIFFERENCES
from services.core.errors import CorruptStoreError
from services.core.geometry import Camera, Light, Mesh
from services.core.pages.pictures import Picture, png_bytes
from services.core.store import StoredArray, write_atomic

DIFFERENCES = TypeAdapter(list[ColourDifference])


def write_lead_picture(
    folder: Path,
    job: FittedJob,
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    cavity: Mesh | None = None,
) -> tuple[str, ...]:
    """Write ``render_beside_photograph.png`` and ``colour_differences.json``, and return their names.

    Nothing is written of stained teeth and of jobs without red, green and blue.

    Args:
        folder: the asset's folder.
        job: the fitted job.
        cameras, lights: those of the asset, in its frame.
        cavity: of a jaw, what is behind its teeth.
    """
    if job.stains is not None:
        return ()
    radiance = StoredArray(job.prepared_folder / "prepared.zarr" / "radiance")
    shown = Shown(job.teeth, cameras, lights, middle_of(job.teeth), job.gums, cavity, job.neighbours)
    found = beside(job.spec, job.report, job.prepared, radiance, shown)
    if found is None:
        return ()
    is_simulated = job.spec.rig is not None and job.spec.rig.cameras == "simulated"
    made_by = "Simulated photograph" if is_simulated else "Photograph"
    write_atomic(folder / BESIDE_PHOTOGRAPH, png_bytes(picture(found, made_by)))
    differences = [one for pair in found.pairs if (one := _difference(found, pair)) is not None]
    write_atomic(folder / COLOUR_DIFFERENCES, DIFFERENCES.dump_json(differences))
    return BESIDE_PHOTOGRAPH, COLOUR_DIFFERENCES


def _difference(found: Beside, pair: Pair) -> ColourDifference | None:
    render = square_means(pair.render, pair.render.shape[0] // pair.photo.shape[0])
    shown = Picture(found.camera, pair.lit, pair.held_out, pair.photo, render, pair.compared)
    # Developed colours are relative to a diffuser, in linear sRGB.
    return colour_difference(shown, np.ones(3), CameraWhite(None), pair.render_noise)


def read_differences(asset: Path) -> list[ColourDifference]:
    """The differences of an asset's picture; none of an asset without one.

    Raises:
        CorruptStoreError: the file cannot be read.
    """
    path = asset / COLOUR_DIFFERENCES
    try:
        return DIFFERENCES.validate_json(path.read_bytes()) if path.is_file() else []
    except ValidationError as problem:
        raise CorruptStoreError(f"{path} cannot be read; write it again with dentine export.") from problem
