"""Surfaces that a capture shows: teeth, gums and the wall of the mouth. A jaw's fit models all of them, a single
tooth's fit the tooth and, where asked, gums and other teeth as its surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.meshes import note_on_dropped, read_mesh, read_teeth
from services.core.geometry import OBJECT, Camera, Mesh, Tooth, inner_file, teeth_folder
from services.core.raw.registration import REGISTRATION
from services.preprocess.views.projection import Footprint, project
from services.preprocess.views.source import View
from services.preprocess.views.window import window_of

NO_SURFACE = -1


@dataclass(frozen=True)
class Subject:
    """The surfaces of a capture.

    Numbers in a footprint: teeth by their index, then one number for the gums and one for the wall, -1 for no surface.
    """

    teeth: tuple[Tooth, ...]
    gums: Mesh | None
    cavity: Mesh | None
    """Wall of the mouth, an open surface that is visible from both sides."""
    whole: bool
    """Whether gums and wall are fitted too; otherwise gums are occluders."""
    others: tuple[Tooth, ...] = ()
    """Teeth that are not fitted and therefore are occluders."""
    surroundings: bool = False
    """Whether the fit renders the occluders, with light that passes between them and the tooth."""

    @property
    def gums_number(self) -> int:
        """Number of the gums in a footprint."""
        return len(self.teeth)

    @property
    def cavity_number(self) -> int:
        """Number of the wall in a footprint."""
        return len(self.teeth) + 1

    @property
    def occluders(self) -> tuple[Mesh, ...]:
        """Occluders: surfaces that hide and shade others and are not fitted."""
        others = tuple(tooth.outer for tooth in self.others)
        return others if self.gums is None or self.whole else (*others, self.gums)

    def fitted_meshes(self) -> list[Mesh]:
        """Surfaces that are fitted, and that a camera's window must contain."""
        around = [mesh for mesh in (self.gums, self.cavity) if mesh is not None and self.whole]
        return [tooth.outer for tooth in self.teeth] + around

    @property
    def note(self) -> str | None:
        """A sentence on vertices of the files that were left out; None where there are none."""

        def name(tooth: Tooth, file: str) -> str:
            return str(teeth_folder(Path(), tooth.fdi) / file)

        named = {name(tooth, "outer.ply"): tooth.outer for tooth in (*self.teeth, *self.others)}
        named |= {name(one, inner_file(one.fdi)): one.dentin for one in self.teeth if one.dentin is not None}
        around = {"gums.ply": self.gums, "cavity.ply": self.cavity}
        return note_on_dropped(named | {name: mesh for name, mesh in around.items() if mesh is not None})

    def rendered_meshes(self) -> list[Mesh]:
        """Surfaces whose shadows the fit renders."""
        return self.fitted_meshes() + (list(self.occluders) if self.surroundings else [])

    def view_of(self, number: int, camera: Camera) -> View:
        """Window and footprint of the subject in one camera's images."""
        window = window_of(camera, self.fitted_meshes())
        cropped = window.cropped(camera)
        return View(number, camera, window, cropped, self.footprint_in(cropped))

    def footprint_in(self, camera: Camera) -> Footprint:
        """Footprint of all fitted surfaces in a camera, with the occluders taken into account."""
        outers = [tooth.outer for tooth in self.teeth]
        if not self.whole:
            return project(camera, outers, self.occluders)
        shown = dict(enumerate(outers))
        if self.gums is not None:
            shown[self.gums_number] = self.gums
        if self.cavity is not None:
            shown[self.cavity_number] = _two_sided(self.cavity)
        footprint = project(camera, list(shown.values()))
        numbers = np.array([*shown, NO_SURFACE], dtype=np.int16)
        return replace(footprint, mesh=numbers[footprint.mesh])

    def glossy(self, footprint: Footprint) -> tuple[NDArray[np.bool_], ...]:
        """Masks (H, W) of the glossy surfaces, one for teeth and one for gums because their colours differ."""
        teeth = (footprint.mesh >= 0) & (footprint.mesh < len(self.teeth))
        return (teeth, footprint.mesh == self.gums_number) if self.whole else (teeth,)

    def pixels_of_teeth(self, footprint: Footprint, bits: NDArray[np.uint16]) -> NDArray[np.int64]:
        """Numbers (teeth,) of valid pixels that show each tooth."""
        labels = footprint.mesh[(bits == 0) & (footprint.mesh >= 0)]
        return np.bincount(labels, minlength=len(self.teeth))[: len(self.teeth)]


def read_subject(
    root: Path,
    whole: bool,
    fdi: int | None = None,
    surroundings: Literal["auto", "on", "off"] = "off",
    *,
    is_object: bool = False,
    verify: bool = True,
) -> Subject:
    """Read ``teeth/``, ``gums.ply`` and, if everything is fitted, ``cavity.ply`` of a capture; or its ``object/``.

    Args:
        root: folder of the capture.
        whole: whether gums and wall are fitted too.
        fdi: number of the only tooth to fit; None for all.
        surroundings: whether the fit of a tooth renders gums and other teeth; auto for where they were registered.
        is_object: whether the capture shows an object that is no tooth, and nothing else.
        verify: whether the surfaces are checked.

    Raises:
        CaptureInputError: there is no tooth, or not the one asked for, or a file cannot be read. MeshError: a surface
            cannot bound a medium.
    """
    if is_object:
        return Subject(read_teeth(root, (OBJECT,), verify=verify), None, None, whole=False)
    teeth, gums = read_teeth(root, verify=verify), _optional(root / "gums.ply")
    chosen = tuple(tooth for tooth in teeth if fdi in {None, tooth.fdi})
    if not chosen:
        raise CaptureInputError(
            f"Option 'fdi' names tooth {fdi}, but the capture has {', '.join(str(tooth.fdi) for tooth in teeth)}; name"
            " one of these."
        )
    cavity = _optional(root / "cavity.ply") if whole else None
    others = tuple(tooth for tooth in teeth if fdi not in {None, tooth.fdi})
    asked = surroundings == "on" or (surroundings == "auto" and (root / REGISTRATION).is_file())
    are_rendered = asked and not whole and (gums is not None or bool(others))
    if verify and (whole or are_rendered) and gums is not None:
        gums.require_solid("gums.ply")
    if verify and cavity is not None:
        cavity.require_surface("cavity.ply")
    return Subject(chosen, gums, cavity, whole, others, are_rendered)


def _optional(path: Path) -> Mesh | None:
    return read_mesh(path) if path.exists() else None


def _two_sided(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_mm, np.concatenate([mesh.faces, mesh.faces[:, ::-1]]))
