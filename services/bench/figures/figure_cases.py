"""Definitions of the captures and fits that the figures show, at full or reduced size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.bench.figures.cases import Capture, Case
from services.bench.figures.gallery import tooth_surfaces
from services.core.files.meshes import write_mesh
from services.core.records import FolderCapture
from services.core.store import read_record

FRONT_LIGHTS = tuple(f"l{n}" for n in range(9))
"""The nine of eighteen lights that lie up to 70 degrees from the front."""
SIDE_LIGHTS = tuple(f"l{n}" for n in range(9, 18))
"""The other nine lights, from there to 108 degrees, a little from behind."""
FIVE_LIGHTS, FIVE_OTHERS = ("l0", "l4", "l8", "l12", "l16"), ("l2", "l6", "l10", "l14", "l17")
SPREAD_LIGHTS = tuple(f"l{n}" for n in range(12) if n % 4 != 3)
"""Nine of twelve lights, spread over all of them."""
JAW_LIGHTS = tuple(f"l{n}" for n in range(5))


@dataclass(frozen=True)
class Effort:
    """Sizes of the captures and fits, and numbers of paths of the figures' own renders."""

    tooth_mm: float
    single_view_mm: float
    jaw_mm: float
    step: int
    """Edge in pixels of the squares to whose means teeth are fitted."""
    photo_samples: int
    jaw_photo_samples: int
    shown_samples: int
    tooth_job: Mapping[str, Any]
    jaw_job: Mapping[str, Any]
    environment_samples: int
    environment_px: int
    ambient: tuple[float, ...]
    """Strengths of the constant light from all around, as fractions of the photographs' mean radiance."""


FULL = Effort(
    0.4, 0.6, 1.0, 2, 256, 512, 512,
    {"samples_per_pixel": 64, "max_samples_per_pixel": 1024, "max_steps": 6, "search_candidates": 5000,
     "advise": False},
    {"samples_per_pixel": 16, "max_samples_per_pixel": 32, "max_steps": 4, "search_candidates": 1000, "advise": False},
    256, 240, (0.0, 0.02, 0.05, 0.1),
)  # fmt: skip
QUICK = Effort(
    0.8, 0.8, 2.0, 1, 128, 64, 64,
    {"samples_per_pixel": 32, "max_samples_per_pixel": 64, "max_steps": 3, "search_candidates": 1000, "advise": False},
    {"samples_per_pixel": 8, "max_samples_per_pixel": 8, "max_steps": 1, "search_candidates": 1000, "advise": False},
    32, 100, (0.0, 0.1),
)  # fmt: skip


@dataclass(frozen=True)
class FigureCases:
    """Captures and fits of all figures."""

    effort: Effort
    work: Path
    """Folder in which captures and fits are kept."""
    scan: Path | None = None
    """Folder capture of a scanned incisor whose meshes are used; None for the procedural incisor."""

    @property
    def tooth_name(self) -> str:
        """Name of the incisor in captions."""
        return "a procedural incisor" if self.scan is None else "a micro-CT incisor"

    def _incisor(self) -> dict[str, Any]:
        # Turn the scanned incisor upright, with its front towards the cameras of its own capture.
        if self.scan is None:
            return {}
        files = {name: self.work / "incisor" / f"{name}.ply" for name in ("outer", "dentin")}
        if not all(file.is_file() for file in files.values()):
            description = read_record(self.scan / "capture.json", FolderCapture)
            towards = np.mean([camera.rays(np.zeros(1), np.zeros(1))[0] for camera in description.cameras], axis=0)
            (tooth,) = (self.scan / "teeth").iterdir()
            for name, mesh in tooth_surfaces(
                tooth / "outer.ply", tooth / "dentin.ply", tuple(towards.tolist())
            ).items():
                write_mesh(files[name], mesh)
        return {name: str(file) for name, file in files.items()}

    def _isolated(
        self, name: str, cameras: tuple[str, ...], fitted: tuple[str, ...], lights: tuple[str, ...], channels: int = 1
    ) -> Case:
        # Return a fit of an isolated tooth with known dentin; its capture has three cameras and eighteen lights.
        capture = self._phantom(
            f"tooth{channels}",
            self.effort.tooth_mm,
            self.effort.photo_samples,
            cameras=3,
            lights=18,
            channels=channels,
            **self._incisor(),
        )
        return Case(
            name,
            capture,
            cameras,
            fitted,
            lights,
            {"dentin": "known", "pixel_step": self.effort.step} | dict(self.effort.tooth_job),
        )

    @property
    def front(self) -> Case:
        """A fit of one camera under the front lights."""
        return self._isolated("front", ("c1", "c2"), ("c1",), FRONT_LIGHTS)

    @property
    def five_lights(self) -> Case:
        """A fit of three cameras under five lights, in colour."""
        cameras = ("c0", "c1", "c2")
        return self._isolated("five-lights", cameras, cameras, FIVE_LIGHTS, channels=3)

    @property
    def two_cameras(self) -> Case:
        """A fit of two of three cameras."""
        return self._isolated("two-cameras", ("c0", "c1", "c2"), ("c1", "c2"), FIVE_LIGHTS)

    @property
    def stained(self) -> Case:
        """A fit of a stained incisor."""
        capture = self._phantom(
            "stained", self.effort.tooth_mm, 2 * self.effort.photo_samples, cameras=2, lights=12, stains=True, seed=4
        )
        options = {"dentin": "known", "pixel_step": self.effort.step, "stains": True} | dict(self.effort.tooth_job)
        return Case("stained", capture, ("c0", "c1"), ("c0", "c1"), SPREAD_LIGHTS, options)

    @property
    def single_view(self) -> Case:
        """A fit of one view of the procedural incisor under nine of twelve lights; small, for figures that need many
        fits.
        """
        capture = self._phantom(
            "lone-view", self.effort.single_view_mm, 2 * self.effort.photo_samples, cameras=1, lights=12
        )
        return Case(
            "lone-view", capture, ("c0",), ("c0",), SPREAD_LIGHTS, {"dentin": "known"} | dict(self.effort.tooth_job)
        )

    def jaw(self, subject: int, fitted: tuple[str, ...] = ("c0", "c1", "c2")) -> Case:
        """Return a fit of a whole jaw of a random subject."""
        capture = self._phantom(
            f"jaw{subject}",
            self.effort.jaw_mm,
            self.effort.jaw_photo_samples,
            cameras=3,
            lights=6,
            jaw=True,
            subject=subject,
        )
        return Case(
            f"jaw{subject}",
            capture,
            ("c0", "c1", "c2"),
            fitted,
            JAW_LIGHTS,
            {"kind": "jaw", "dentin": "known"} | dict(self.effort.jaw_job),
        )

    @staticmethod
    def _phantom(name: str, pixel_mm: float, samples: int, **options: Any) -> Capture:
        named = {key.replace("_", "-"): value for key, value in options.items()}
        return Capture(name, {"pixel-mm": pixel_mm, "samples": samples, "boundary": "thin"} | named)
