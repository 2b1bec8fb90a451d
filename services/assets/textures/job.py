"""The texture sets of a job's asset."""

from __future__ import annotations

from pathlib import Path

from services.assets.content import AssetContent
from services.assets.textures.thickness import thicknesses
from services.assets.textures.tooth import ToothTextures, bake
from services.core.geometry import Tooth
from services.core.records import JobSpec


def bake_textures(job: Path, spec: JobSpec | None, content: AssetContent) -> dict[str, ToothTextures]:
    """The textures of every tooth on which something differs from point to point, by the name of the part.

    Args:
        job: the job's folder, whose fit tells the standard error of the thickness.
        spec: the job's options; None where they are not known.
        content: its asset.
    """
    enamels = {part.fdi: part for part in content.parts if part.fdi is not None and part.tissue == "enamel"}
    dentins = {part.fdi: part for part in content.parts if part.fdi is not None and part.tissue == "dentin"}
    teeth = tuple(
        Tooth(fdi, part.surface, dentins[fdi].surface if fdi in dentins else None) for fdi, part in enamels.items()
    )
    thickness = thicknesses(job, spec, teeth)
    sets = {}
    for fdi, part in enamels.items():
        media = part.media()
        if media and (fdi in dentins or part.stains):
            core = dentins[fdi].media() if fdi in dentins else {}
            sets[part.name] = bake(part.mesh, media, core, thickness.get(fdi), part.stains, part.stain_errors)
    return sets
