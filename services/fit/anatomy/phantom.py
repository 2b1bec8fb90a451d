"""A virtual mouth: a folder capture of a tooth with known optics, for tests, demonstrations and the simulated cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from services.core.records import Boundary


def write_phantom(
    out: Path,
    *,
    pixel_mm: float = 0.5,
    cameras: int = 3,
    lights: int = 8,
    channels: int = 1,
    boundary: Boundary = "matched",
    seed: int = 1,
    samples: int = 1024,
    outer: Path | None = None,
    dentin: Path | None = None,
    renderer: Literal["engine", "mitsuba"] = "engine",
    highlights: bool = False,
    gums: bool = False,
) -> None:
    """Write a folder capture (``capture.json``, images with variance, ``teeth/11``) and ``truth.json`` with its optics.

    Args:
        pixel_mm: size of a pixel at the tooth.
        channels: 1 (green) or 3 (red, green, blue).
        samples: paths per pixel.
        outer, dentin: meshes of another tooth; both or neither; default the procedural incisor.
        renderer: the project's engine, or stock Mitsuba for boundary ``matched``.
        highlights: add the surface's reflection of each light; also written alone to ``highlights/<camera>_<light>.npy``.
        gums: cover the root with gums, drawn as an opaque diffuse surface; also written as ``gums.ply``.

    Raises:
        InputError: impossible combination of options.
    """
    raise NotImplementedError
