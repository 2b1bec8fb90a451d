"""The asset: a folder that stock Mitsuba renders, with the measured numbers beside it."""

from __future__ import annotations

from pathlib import Path

from services.core.geometry import Camera, Light, Tooth
from services.core.records import Boundary, FitReport


def write_asset(
    folder: Path,
    report: FitReport,
    teeth: tuple[Tooth, ...],
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    *,
    channels: tuple[str, ...],
    boundary: Boundary,
    ior: float,
) -> tuple[str, ...]:
    """Write meshes, one Mitsuba scene per channel, parameters.json and errors.json; returns the files' paths relative to ``folder``.

    Args:
        teeth: with the **fitted** dentin surface (``DentinShape.vertices_mm(shape)``) where the fit had one.
        lights: ``intensity`` in the order of ``channels``.
    """
    raise NotImplementedError
