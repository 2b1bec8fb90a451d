"""Pictures that a fit left, with the maps of its enamel and stains, for the report."""

from __future__ import annotations

from pathlib import Path

from services.assets.report_page import ReportPictures
from services.assets.stains import stain_images
from services.core.geometry import Camera, Tooth
from services.core.pages.pictures import PICTURES, read_pictures
from services.transport.scene.stain_uv import ToothStains
from services.transport.thickness import ThicknessMap


def report_pictures(
    folder: Path,
    channels: tuple[str, ...],
    tooth: Tooth | None,
    cameras: tuple[Camera, ...],
    thickness: ThicknessMap | None = None,
    stains: ToothStains | None = None,
) -> ReportPictures:
    """Pictures for the report. For a single tooth they include the enamel's thickness and the stains, both as the first
    camera sees them.
    """
    pictures = read_pictures(folder / PICTURES)
    if tooth is None:
        return ReportPictures(channels, pictures)
    stain_map, errors = (None, None) if stains is None else stain_images(tooth.outer, stains, cameras[0])
    stained = () if stains is None else tuple(stains.textures)
    return ReportPictures(channels, pictures, thickness, cameras[0].name, stain_map, errors, stained)
