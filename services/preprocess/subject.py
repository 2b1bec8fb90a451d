"""What a capture shows: teeth, and around them gums and the wall of the mouth, which a jaw's fit explains and a single
tooth's does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.meshes import read_mesh, read_teeth
from services.core.geometry import Camera, Mesh, Tooth
from services.preprocess.projection import Footprint, project
from services.preprocess.source import View
from services.preprocess.window import window_of

NOTHING = -1


@dataclass(frozen=True)
class Subject:
    """The surfaces of a capture.

    Numbers in a footprint: teeth by their place, then one for gums and one for the wall, -1 for nothing.
    """

    teeth: tuple[Tooth, ...]
    gums: Mesh | None
    cavity: Mesh | None
    """Open, seen from either side."""
    whole: bool
    """Whether gums and wall are to be fitted too; else gums are in the way."""
    others: tuple[Mesh, ...] = ()
    """Teeth that are not to be fitted, and so are in the way."""

    @property
    def gums_number(self) -> int:
        """Of gums in a footprint."""
        return len(self.teeth)

    @property
    def cavity_number(self) -> int:
        """Of the wall in a footprint."""
        return len(self.teeth) + 1

    @property
    def in_the_way(self) -> tuple[Mesh, ...]:
        """What hides and shades, and is not to be fitted."""
        return self.others if self.gums is None or self.whole else (*self.others, self.gums)

    def fitted_meshes(self) -> list[Mesh]:
        """What a camera's window is to hold."""
        around = [mesh for mesh in (self.gums, self.cavity) if mesh is not None and self.whole]
        return [tooth.outer for tooth in self.teeth] + around

    def view_of(self, number: int, camera: Camera) -> View:
        """What is prepared of a camera's images."""
        window = window_of(camera, self.fitted_meshes())
        cropped = window.cropped(camera)
        return View(number, camera, window, cropped, self.seen_by(cropped))

    def seen_by(self, camera: Camera) -> Footprint:
        """What a camera sees of all that is to be fitted."""
        outers = [tooth.outer for tooth in self.teeth]
        if not self.whole:
            return project(camera, outers, self.in_the_way)
        shown = dict(enumerate(outers))
        if self.gums is not None:
            shown[self.gums_number] = self.gums
        if self.cavity is not None:
            shown[self.cavity_number] = _two_sided(self.cavity)
        footprint = project(camera, list(shown.values()))
        numbers = np.array([*shown, NOTHING], dtype=np.int16)
        return replace(footprint, mesh=numbers[footprint.mesh])

    def glossy(self, footprint: Footprint) -> tuple[NDArray[np.bool_], ...]:
        """Masks (H, W) of the surfaces that reflect, apart because their colours differ."""
        teeth = (footprint.mesh >= 0) & (footprint.mesh < len(self.teeth))
        return (teeth, footprint.mesh == self.gums_number) if self.whole else (teeth,)

    def pixels_of_teeth(self, footprint: Footprint, bits: NDArray[np.uint16]) -> NDArray[np.int64]:
        """How many valid pixels (teeth,) show each tooth."""
        labels = footprint.mesh[(bits == 0) & (footprint.mesh >= 0)]
        return np.bincount(labels, minlength=len(self.teeth))[: len(self.teeth)]


def read_subject(root: Path, whole: bool, fdi: int | None = None) -> Subject:
    """Read ``teeth/``, ``gums.ply`` and, where all is to be fitted, ``cavity.ply`` of a capture.

    Args:
        root: of the capture.
        whole: whether gums and wall are to be fitted too.
        fdi: the one tooth that is to be fitted; None for all.

    Raises:
        CaptureInputError: no tooth is there, or not this one, or a file cannot be read. MeshError: a surface cannot
            bound a medium.
    """
    teeth, gums = read_teeth(root), _optional(root / "gums.ply")
    chosen = tuple(tooth for tooth in teeth if fdi in {None, tooth.fdi})
    if not chosen:
        raise CaptureInputError(
            f"Option 'fdi' names tooth {fdi}, but the capture has {', '.join(str(tooth.fdi) for tooth in teeth)}; name"
            " one of these."
        )
    cavity = _optional(root / "cavity.ply") if whole else None
    if whole and gums is not None:
        gums.require_solid("gums.ply")
    if cavity is not None:
        cavity.require_surface("cavity.ply")
    others = tuple(tooth.outer for tooth in teeth if fdi not in {None, tooth.fdi})
    return Subject(chosen, gums, cavity, whole, others)


def _optional(path: Path) -> Mesh | None:
    return read_mesh(path) if path.exists() else None


def _two_sided(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))
