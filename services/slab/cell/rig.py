"""Input of the forward model from a folder: each light with the cameras that see it, as plain arrays.

Every light is turned into a front light: for a back light the cell is mirrored, so that its cameras change sides and
lateral directions stay. The beam meets the outer face of the cell at x = y = 0, and a pixel is the place where light
leaves the outer face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.slab.folder import Cell, Light, PixelGrid, SlabCamera, SlabFolder
from services.slab.cell.interface import Interface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """Pixels, folded at y = 0 where the grid is symmetric: beams and cameras lie in the plane y = 0, so both halves are
    equal.
    """

    x_from_mm: float
    y_from_mm: float
    pitch_x_mm: float
    pitch_y_mm: float
    columns: int
    rows: int
    """Number of rows, of one half where folded."""
    folded: bool

    @property
    def pixels(self) -> int:
        """Number of values per image."""
        return self.columns * self.rows

    @property
    def area_mm2(self) -> float:
        """Area of the face over which one value averages, mm2."""
        return self.pitch_x_mm * self.pitch_y_mm * (2 if self.folded else 1)


@dataclass(frozen=True)
class Beam:
    """Cross-section of a beam on the face."""

    disc: bool
    x_mm: float
    """Standard deviation (Gaussian beam) or half-axis (disc) along x, stretched by the slant."""
    y_mm: float
    """The same along y."""


@dataclass(frozen=True)
class Views:
    """One light and its cameras (C,). Sines are lateral directions in the medium, signed; those of a perspective camera
    hold at x = y = 0.
    """

    images: NDArray[np.int64]
    """Position of each camera's image in the folder's list."""
    beam: Beam
    sine: float
    transmittance: float
    shift_mm: float
    """Displacement of the beam in the glass, mm."""
    far: NDArray[np.bool_]
    """Whether the camera looks at the face opposite the light."""
    sines: Array
    scales: Array
    """Radiance outside, averaged over a pixel, for one unit of power per sr in the medium that reaches the face there,
    per mm2."""
    shifts_mm: Array
    distances_mm: Array
    """Distance of each camera's centre of projection, infinite for orthographic cameras."""


@dataclass(frozen=True)
class Rig:
    """A cell with its lights and cameras."""

    width_mm: float
    interface: Interface
    grid: Grid
    lights: tuple[Views, ...]
    images: int

    @property
    def shape(self) -> tuple[int, int]:
        """Images and values per image."""
        return self.images, self.grid.pixels


def rig_of(folder: SlabFolder, wavelength_nm: float, index: float | None = None) -> Rig:
    """The rig of one wavelength's images, in their order in the folder."""
    interface = interface_of(folder.cell, index)
    grid = grid_of(folder.pixels)
    cameras = {camera.name: camera for camera in folder.cameras}
    entries = folder.images_at(wavelength_nm)
    views = []
    for light in folder.lights:
        cameras_of_light = [
            (number, cameras[image.camera]) for number, image in enumerate(entries) if image.light == light.name
        ]
        if cameras_of_light:
            views.append(_views(folder, interface, grid, light, cameras_of_light))
    return Rig(folder.cell.width_mm, interface, grid, tuple(views), len(entries))


def interface_of(cell: Cell, index: float | None = None) -> Interface:
    """Faces of the cell; a matched one refracts nothing."""
    if cell.boundary == "matched":
        return Interface(cell.index_outside, cell.index_outside)
    inside = index or cell.index
    assert inside is not None
    if cell.glass is None:
        return Interface(inside, cell.index_outside)
    return Interface(inside, cell.index_outside, cell.glass.index, cell.glass.thickness_mm)


def grid_of(pixels: PixelGrid) -> Grid:
    """The grid, folded where it is symmetric in y."""
    (x_from, x_to), (y_from, y_to) = pixels.x_mm, pixels.y_mm
    pitch_x, pitch_y = (x_to - x_from) / pixels.columns, (y_to - y_from) / pixels.rows
    folded = math.isclose(y_from, -y_to) and pixels.rows % 2 == 0
    rows = pixels.rows // 2 if folded else pixels.rows
    return Grid(x_from, 0.0 if folded else y_from, pitch_x, pitch_y, pixels.columns, rows, folded)


def _views(
    folder: SlabFolder, interface: Interface, grid: Grid, light: Light, cameras_of_light: list[tuple[int, SlabCamera]]
) -> Views:
    sine = interface.inside_sine(light.angle_deg)
    sines = np.array([interface.inside_sine(camera.angle_deg) for _, camera in cameras_of_light])
    # A solid angle shrinks on its way in by (n0/n)^2 cos b / cos b_in; radiance is power per sr outside and projected
    # area.
    solid = (interface.index_outside / interface.index) ** 2 / np.sqrt(1 - sines**2)
    passed = np.array([interface.transmittance(s) for s in sines])
    size = folder.beam.size_mm
    return Views(
        images=np.array([number for number, _ in cameras_of_light]),
        beam=Beam(folder.beam.profile == "disc", size / math.cos(math.radians(light.angle_deg)), size),
        sine=sine,
        transmittance=interface.transmittance(sine),
        shift_mm=interface.glass_shift_mm(sine),
        far=np.array([camera.side != light.side for _, camera in cameras_of_light]),
        sines=sines,
        scales=passed * solid / grid.area_mm2,
        shifts_mm=np.array([interface.glass_shift_mm(s) for s in sines]),
        distances_mm=np.array([camera.distance_mm or math.inf for _, camera in cameras_of_light]),
    )
