"""One HTML file that opens alone: what was measured, how well, and where it fails."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.records import FitReport
from services.fit.export.pictures import Picture


@dataclass(frozen=True)
class ReportPictures:
    """What the report shows as images."""

    channels: tuple[str, ...]
    pictures: tuple[Picture, ...]
    """One fitted and one held-out light per camera is enough."""
    thickness_mm: NDArray[np.floating] | None = None
    """Enamel thickness seen by one camera (H, W), NaN off the tooth; see ``anatomy.thickness.thickness_image``."""
    thickness_camera: str = ""


def write_report(path: Path, report: FitReport, pictures: ReportPictures, history: list[dict[str, Any]], context: dict[str, Any]) -> None:
    """Write the report as one HTML file without any outside reference.

    Args:
        history: one entry per step with ``step``, ``loss`` and, where known, ``held_out_error`` and ``stage``.
        context: ``title``, ``boundary``, ``ior`` and ``provenance`` (a dict of label -> text); all optional.
    """
    raise NotImplementedError
