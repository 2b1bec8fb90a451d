"""A virtual object of known optics that is no tooth: a folder capture of a sphere, a cube, or a surface from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from services.core.errors import InputError
from services.core.files.meshes import OBJECT_EXTENT_MM, read_mesh
from services.core.geometry import OBJECT, Mesh, Tooth
from services.core.records import Boundary
from services.core.surface.rough import DEFAULT_ROUGHNESS
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.files import (
    CHANNELS,
    Renderer,
    held_out_lights,
    medium_truth,
    require_rig,
    write_description,
    write_images,
)
from services.phantom.reflection import reflect
from services.phantom.surface import IOR, PhantomSurface
from services.phantom.tooth import render_tooth, write_meshes
from services.transport.optics.parameters import Medium, Tissue

SHAPES = ("sphere", "cube")
SIZE_MM = 10.0
"""Diameter of the sphere and edge of the cube, mm: as large as a tooth, so that its light scatters often inside."""
SUBDIVISIONS = 4
"""Of the icosahedron that stands for the sphere: its volume is 0.4 % below that of the sphere about it."""
TRUE_BODY = {
    "red": Medium(2.0, 0.997, g1=0.5),
    "green": Medium(2.2, 0.994, g1=0.5),
    "blue": Medium(2.5, 0.988, g1=0.5),
}
"""True media by channel: like a cast silicone with pigment, reduced scattering 1 to 1.2 per mm."""
TRUE_CORE = {
    "red": Medium(6.0, 0.99, g1=0.5),
    "green": Medium(6.5, 0.98, g1=0.5),
    "blue": Medium(7.0, 0.96, g1=0.5),
}
"""True media of the core, denser and darker than the body."""


def write_object_phantom(
    out: Path,
    *,
    shape: str = "sphere",
    core: Path | None = None,
    pixel_mm: float = 0.5,
    cameras: int = 1,
    lights: int = 3,
    channels: int = 1,
    boundary: Boundary = "matched",
    ior: float = IOR,
    roughness: float = DEFAULT_ROUGHNESS,
    multiple_scattering: bool = True,
    seed: int = 1,
    samples: int = 1024,
    renderer: Renderer = "engine",
    held_out: int | None = None,
    is_paired: bool = False,
) -> None:
    """Write a folder capture (``capture.json``, images with variance, ``object/``) and ``truth.json`` with its optics.

    Args:
        out: folder to write.
        shape: one of ``SHAPES``, or the path of a closed surface in mm.
        core: surface of a core of another medium, in mm and in the frame of the shape; None for a homogeneous object.
        pixel_mm: size of a pixel at the object.
        cameras, lights: numbers of cameras and lights.
        channels: 1 (green) or 3 (red, green, blue).
        boundary: model of the object's surface.
        ior, roughness, multiple_scattering: of the surface, see ``PhantomSurface``.
        seed: seed of the rendering and of the lights' brightness.
        samples: paths per pixel.
        renderer: the project's engine, or stock Mitsuba for boundary ``matched`` or a ``rough`` one without
            ``multiple_scattering``.
        held_out: number of lights that are marked as held out; default every fourth.
        is_paired: each camera sees the light of its own number alone; there are as many of both.

    Raises:
        InputError: the combination of options is impossible. MeshError: a surface is open or inside out.
    """
    face = PhantomSurface(boundary, ior, roughness, multiple_scattering)
    require_rig(pixel_mm, cameras, lights, channels, samples, held_out, face, renderer)
    if is_paired and cameras != lights:
        raise InputError(f"{cameras} cameras and {lights} lights are no pairs; give as many of both.")
    solid = object_surfaces(shape, core)
    names = CHANNELS[channels]
    rig_lights = dome_lights(lights, names, seed)
    rig_cameras = dome_cameras(cameras, pixel_mm, (solid.outer,))
    write_meshes(out, solid, None)
    entries, held_out_indices = [], held_out_lights(lights, held_out)
    for number, camera in enumerate(rig_cameras):
        shown = rig_lights[number : number + 1] if is_paired else rig_lights
        surface = reflect(solid.outer, None, camera, shown, names, 1.0)
        stacks = [
            render_tooth(
                out, solid, camera, shown, c, Tissue(TRUE_BODY[name], TRUE_CORE[name]), surface, face,
                renderer, samples, seed + 7919 * number,
            )
            for c, name in enumerate(names)
        ]  # fmt: skip
        mean, variance = (np.stack([stack[k] for stack in stacks], axis=-1) for k in range(2))
        entries += write_images(out, camera, shown, mean, variance, held_out_indices)
    media = {
        name: {"body": medium_truth(TRUE_BODY[name])}
        | ({} if core is None else {"core": medium_truth(TRUE_CORE[name])})
        for name in names
    }
    settings = {"channels": media, "renderer": renderer, "samples_per_pixel": samples, "seed": seed}
    write_description(out, names, rig_cameras, rig_lights, entries, face.truth() | settings)


def object_surfaces(shape: str, core: Path | None) -> Tooth:
    """The surfaces of a shape and of its core, moved together so that the middle of the shape lies at the origin, where
    single precision is best.

    Raises:
        InputError: there is no such shape and no such file. MeshError: a surface is open or inside out.
    """
    outer, inner = outer_surface(shape), None if core is None else _solid(core)
    middle = (outer.vertices_mm.min(axis=0) + outer.vertices_mm.max(axis=0)) / 2
    moved_core = None if inner is None else Mesh(inner.vertices_mm - middle, inner.faces)
    return Tooth(OBJECT, Mesh(outer.vertices_mm - middle, outer.faces), moved_core)


def outer_surface(shape: str) -> Mesh:
    """The surface of ``SHAPES``, about the origin, or that of a file.

    Raises:
        InputError: there is no such shape and no such file. MeshError: the file's surface is open or inside out.
    """
    import trimesh

    if shape == "sphere":
        made = trimesh.creation.icosphere(SUBDIVISIONS, SIZE_MM / 2)
    elif shape == "cube":
        made = trimesh.creation.box((SIZE_MM,) * 3)
    elif Path(shape).is_file():
        return _solid(Path(shape))
    else:
        raise InputError(f"Option --object names '{shape}'; give {', '.join(SHAPES)}, or the file of a closed surface.")
    return Mesh(np.asarray(made.vertices, dtype=np.float64), np.asarray(made.faces, dtype=np.int32))


def _solid(path: Path) -> Mesh:
    mesh = read_mesh(path)
    mesh.require_solid(str(path), OBJECT_EXTENT_MM)
    return mesh
