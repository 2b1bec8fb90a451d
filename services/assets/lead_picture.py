"""The picture with which a report begins, written into the asset: photographs beside renders of it, in colour."""

from __future__ import annotations

from pathlib import Path

from services.assets.asset import middle_of
from services.assets.colour.beside import Shown, beside
from services.assets.colour.beside_picture import picture
from services.assets.fitted_job import FittedJob
from services.assets.provenance.departing import BESIDE_PHOTOGRAPH
from services.core.geometry import Camera, Light
from services.core.pages.pictures import png_bytes
from services.core.store import StoredArray, write_atomic


def write_lead_picture(
    folder: Path, job: FittedJob, cameras: tuple[Camera, ...], lights: tuple[Light, ...]
) -> tuple[str, ...]:
    """Write ``render_beside_photograph.png`` and return its name.

    Nothing is written of a jaw, of stained teeth, and of jobs without red, green and blue.

    Args:
        folder: the asset's folder.
        job: the fitted job.
        cameras, lights: those of the asset, in its frame.
    """
    if job.stains is not None:
        return ()
    radiance = StoredArray(job.prepared_folder / "prepared.zarr" / "radiance")
    shown = Shown(job.teeth, cameras, lights, middle_of(job.teeth))
    found = beside(job.spec, job.report, job.prepared, radiance, shown)
    if found is None:
        return ()
    is_simulated = job.spec.rig is not None and job.spec.rig.cameras == "simulated"
    made_by = "Simulated photograph" if is_simulated else "Photograph"
    write_atomic(folder / BESIDE_PHOTOGRAPH, png_bytes(picture(found, made_by)))
    return (BESIDE_PHOTOGRAPH,)
