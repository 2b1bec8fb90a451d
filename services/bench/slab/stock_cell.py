"""Images of an index-matched cell by stock Mitsuba, which share no code with the slab's kernel.

Stock Mitsuba has no narrow beam to which a path from a camera can be connected. A directional light through a black
plate whose opacity is one minus the beam's profile serves as such a beam, because Mitsuba's integrators multiply every
connection by the plate's transmittance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.slab.cell import near_beam_folder
from services.core.slab.folder import Light, SlabCamera, SlabFolder

Array = NDArray[np.float64]

HALF_CELL_MM = 12.0
"""Half edge of the cell across, twice that of the pixels: light that leaves there would not return to a pixel."""
HALF_PLATE_MM, PLATE_NODES, PLATE_AWAY_MM = 14.0, 2048, 60.0
"""Half edge of the plate, its number of nodes and its distance from the cell. The plate shades the whole cell, the
distance of its nodes is a 70th of the beam's size, and it stands behind all cameras."""
COSINES = 20_001
"""Number of nodes of the phase function's table."""
MAX_ORDER = 256


def matched_folder() -> SlabFolder:
    """Return the benchmarks' cell with a matched boundary, under a beam of 1 mm.

    The beam has to be this broad for stock Mitsuba, because a connection from a point outside the beam contributes
    nothing.
    """
    return near_beam_folder(
        cell={"width_mm": 1.0, "index": None, "boundary": "matched"},
        beam={"profile": "gaussian", "sigma_mm": 1.0},
        pixels={"x_mm": [-6.0, 6.0], "y_mm": [-6.0, 6.0], "columns": 12, "rows": 12},
    )


def scenes(folder: SlabFolder, medium: dict[str, Any], integrator: str) -> Iterator[tuple[Any, bool]]:
    """Yield a scene for each of the folder's images, and whether its camera is in front."""
    import mitsuba as mi

    lights = {light.name: light for light in folder.lights}
    cameras = {camera.name: camera for camera in folder.cameras}
    plate = mi.Bitmap(_plate(folder).astype(np.float32)[..., None])
    for entry in folder.images:
        light, camera = lights[entry.light], cameras[entry.camera]
        yield _scene(folder, medium, light, camera, plate, integrator), camera.side == "front"


def turned(image: Array, *, front: bool) -> Array:
    """Convert a film (rows, columns) to a folder's image, or a folder's image to a film.

    A film's rows run downwards, and the columns of a camera in front run against x.
    """
    return image[::-1, ::-1] if front else image[::-1]


def medium_of(extinction_per_mm: float, albedo: float, phase_per_sr: Callable[[Array], Array]) -> dict[str, Any]:
    """Return the Mitsuba dictionary of a homogeneous medium with a tabulated phase function.

    Args:
        extinction_per_mm: extinction coefficient.
        albedo: single-scattering albedo.
        phase_per_sr: phase function of the scattering angle in rad; its scale is arbitrary.
    """
    values = phase_per_sr(node_angles())
    return {
        "type": "homogeneous",
        "sigma_t": extinction_per_mm,
        "albedo": albedo,
        "phase": {"type": "tabphase", "values": ", ".join(f"{value:.7g}" for value in values)},
    }


def node_angles() -> Array:
    """Return the scattering angles (COSINES,) in rad of the phase function's table."""
    return np.asarray(np.arccos(np.linspace(-1.0, 1.0, COSINES)))


def _plate(folder: SlabFolder) -> Array:
    """Return the opacity of the plate (PLATE_NODES, PLATE_NODES)."""
    across = (np.arange(PLATE_NODES) + 0.5) / PLATE_NODES * 2 * HALF_PLATE_MM - HALF_PLATE_MM
    squared = across[:, None] ** 2 + across[None] ** 2
    return 1 - np.exp(-squared / (2 * folder.beam.size_mm**2))


def _direction(side: str, angle_deg: float, *, arriving: bool) -> Array:
    """Return the direction of propagation of a beam that arrives at a face, or of light that leaves it."""
    forward = 1.0 if (side == "front") == arriving else -1.0
    return np.array([math.sin(math.radians(angle_deg)), 0.0, forward * math.cos(math.radians(angle_deg))])


def _scene(
    folder: SlabFolder, medium: dict[str, Any], light: Light, camera: SlabCamera, plate: Any, integrator: str
) -> Any:
    import mitsuba as mi

    width = folder.cell.width_mm
    transform = mi.ScalarTransform4f

    def facing(side: str, away: Array) -> Any:
        face = np.array([0.0, 0.0, 0.0 if side == "front" else width])
        return transform().look_at(origin=(face + away).tolist(), target=face.tolist(), up=[0, 1, 0])

    beam = _direction(light.side, light.angle_deg, arriving=True)
    half_x, half_y = (0.5 * (high - low) for low, high in (folder.pixels.x_mm, folder.pixels.y_mm))
    scale = [half_x * math.cos(math.radians(camera.angle_deg)), half_y, 1]
    view = facing(camera.side, 10 * _direction(camera.side, camera.angle_deg, arriving=False))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "max_depth": MAX_ORDER, "rr_depth": 2 * MAX_ORDER},
            "cell": {
                "type": "cube",
                "to_world": transform().translate([0, 0, width / 2]).scale([HALF_CELL_MM, HALF_CELL_MM, width / 2]),
                "bsdf": {"type": "null"},
                "interior": medium,
            },
            "light": {
                "type": "directional",
                "direction": beam.tolist(),
                "irradiance": folder.beam.power / (2 * math.pi * folder.beam.size_mm**2),
            },
            "plate": {
                "type": "rectangle",
                "to_world": facing(light.side, -PLATE_AWAY_MM * beam)
                @ transform().scale([HALF_PLATE_MM, HALF_PLATE_MM, 1]),
                "bsdf": {
                    "type": "mask",
                    "opacity": {"type": "bitmap", "bitmap": plate, "raw": True, "wrap_mode": "clamp"},
                    "nested": {"type": "diffuse", "reflectance": 0.0},
                },
            },
            "sensor": {
                "type": "orthographic",
                "to_world": view @ transform().scale(scale),
                "film": {
                    "type": "hdrfilm",
                    "width": folder.pixels.columns,
                    "height": folder.pixels.rows,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
            },
        },
        optimize=False,
    )
