"""A virtual tooth: a folder capture with known optics, for tests, demonstrations and simulated cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.assets.stains import write_textures
from services.core.errors import InputError
from services.core.files.meshes import read_mesh, write_mapped_mesh, write_mesh
from services.core.geometry import Camera, Light, Mesh, Tooth, inner_file, teeth_folder
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
    write_image,
    write_images,
)
from services.phantom.reflection import Reflection, reflect
from services.phantom.render import Stack, render_engine, render_mitsuba
from services.phantom.stain_paint import painted_stains
from services.phantom.subjects import subject_tissues
from services.phantom.surface import INK, IOR, PhantomSurface
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from services.transport.scene.recipe import single_tooth
from services.transport.scene.stain_uv import ToothStains, store_stains

FDI = 11
"""FDI number of the procedural incisor."""
FDI_NUMBERS = tuple(10 * quadrant + place for quadrant in range(1, 5) for place in range(1, 9))
"""FDI numbers of all permanent teeth."""
TRUE_TISSUE = {
    "red": Tissue(Medium(4.2, 0.9980, g1=0.80), Medium(11.0, 0.9965, g1=0.75)),
    "green": Tissue(Medium(4.5, 0.9970, g1=0.80), Medium(12.0, 0.9945, g1=0.75)),
    "blue": Tissue(Medium(5.0, 0.9955, g1=0.80), Medium(13.0, 0.9905, g1=0.75)),
}
"""True media by channel, within the literature's spread. Absorption increases towards blue, in dentin more than in
enamel, which gives the yellow colour of teeth."""


def write_phantom(
    out: Path,
    *,
    pixel_mm: float = 0.5,
    cameras: int = 3,
    lights: int = 8,
    channels: int = 1,
    boundary: Boundary = "matched",
    ior: float = IOR,
    roughness: float = DEFAULT_ROUGHNESS,
    multiple_scattering: bool = True,
    seed: int = 1,
    samples: int = 1024,
    outer: Path | None = None,
    dentin: Path | None = None,
    fdi: int | None = None,
    renderer: Renderer = "engine",
    highlights: bool = False,
    gums: bool = False,
    stains: bool = False,
    held_out: int | None = None,
    subject: int | None = None,
) -> None:
    """Write a folder capture (``capture.json``, images with variance, ``teeth/<FDI>``) and ``truth.json`` with its
    optics.

    Args:
        out: folder to write.
        pixel_mm: size of a pixel at the tooth.
        cameras, lights: numbers of cameras and lights.
        channels: 1 (green) or 3 (red, green, blue).
        boundary: model of the tooth's outer boundary.
        ior, roughness, multiple_scattering: of the surface, see ``PhantomSurface``.
        seed: seed of the rendering, of the lights' brightness and of stains.
        samples: paths per pixel.
        outer: enamel surface of another tooth, in the canonical frame (x mesial, y buccal, z occlusal) or near it;
            default the procedural incisor.
        dentin: dentin surface of the other tooth, given with ``outer``.
        fdi: FDI number of the other tooth, given with ``outer``; default ``FDI``.
        renderer: the project's engine, or stock Mitsuba for boundary ``matched`` or a ``rough`` one without
            ``multiple_scattering``.
        highlights: add the surface's reflection of each light; it is also written alone to
            ``highlights/<camera>_<light>.npy``.
        gums: cover the root with gums, an opaque diffuse surface that exchanges no light with the tooth; it is also
            written as ``gums.ply``.
        stains: paint stains on the enamel; they are also written as ``stains.npz``.
        held_out: number of lights that are marked as held out; default every fourth.
        subject: seed of a random subject's optics; None for ``TRUE_TISSUE``.

    Raises:
        InputError: the combination of options is impossible.
    """
    _require_possible(boundary, outer, dentin, fdi, highlights, gums, stains)
    face = PhantomSurface(boundary, ior, roughness, multiple_scattering)
    require_rig(pixel_mm, cameras, lights, channels, samples, held_out, face, renderer)
    tooth, collar = _tooth(outer, dentin, FDI if fdi is None else fdi)
    shown_gums = collar if gums else None
    names = CHANNELS[channels]
    tissues = TRUE_TISSUE if subject is None else subject_tissues(subject, names)
    rig_lights = dome_lights(lights, names, seed)
    rig_cameras = dome_cameras(cameras, pixel_mm, (tooth.outer,))
    write_meshes(out, tooth, shown_gums)
    painted = painted_stains(tooth.outer, names, seed) if stains else None
    if painted is not None:
        store_stains(out, painted)
    stained = {
        name: tissues[name] if painted is None else replace(tissues[name], stain=painted.textures[name])
        for name in names
    }

    entries, held_out_indices = [], held_out_lights(lights, held_out)
    for number, camera in enumerate(rig_cameras):
        surface = reflect(tooth.outer, shown_gums, camera, rig_lights, names, ior, face.shine)
        stacks = [
            render_tooth(
                out, tooth, camera, rig_lights, c, stained[name], surface, face, renderer, samples,
                seed + 7919 * number, painted,
            )
            for c, name in enumerate(names)
        ]  # fmt: skip
        mean, variance = (np.stack([stack[k] for stack in stacks], axis=-1) for k in range(2))
        share = surface.enamel_share[None, ..., None]
        mean, variance = mean * share + surface.gums, variance * share**2
        if highlights:
            mean = mean + surface.highlight
        entries += write_images(out, camera, rig_lights, mean, variance, held_out_indices)
        if highlights:
            for n, light in enumerate(rig_lights):
                write_image(out / "highlights" / f"{camera.name}_{light.name}.npy", surface.highlight[n])
    truth = _truth({name: tissues[name] for name in names}, face, renderer, samples, seed, highlights, gums) | {
        "stains": stains
    }
    write_description(out, names, rig_cameras, rig_lights, entries, truth)


def _require_possible(
    boundary: Boundary,
    outer: Path | None,
    dentin: Path | None,
    fdi: int | None,
    highlights: bool,
    gums: bool,
    stains: bool,
) -> None:
    if dentin is not None and outer is None:
        raise InputError("A dentin mesh was given without its enamel's outer mesh; give both.")
    if fdi is not None and outer is None:
        raise InputError(
            f"The procedural incisor is tooth {FDI}; leave out the FDI number, or give the outer mesh that it names."
        )
    if fdi is not None and fdi not in FDI_NUMBERS:
        raise InputError(f"{fdi} is no tooth's FDI number; give one of 11 to 18, 21 to 28, 31 to 38 or 41 to 48.")
    if outer is not None and gums:
        raise InputError("Gums are made for the procedural incisor only; leave out either the gums or the outer mesh.")
    if highlights and boundary == "matched":
        raise InputError(
            "An index-matched surface has no highlights; choose boundary thin or leave the highlights out."
        )
    if stains and boundary == "rough":
        raise InputError("A rough surface has no stains; leave them out, or choose boundary thin.")


def _tooth(outer: Path | None, dentin: Path | None, fdi: int) -> tuple[Tooth, Mesh]:
    # Move foreign meshes to the origin, where single precision is most accurate.
    incisor = build_incisor()
    if outer is None:
        return Tooth(fdi, incisor.outer, incisor.dentin), incisor.gums
    shell = read_mesh(outer)
    shell.require_solid(str(outer))
    centre = (shell.vertices_mm.min(axis=0) + shell.vertices_mm.max(axis=0)) / 2
    core = None
    if dentin is not None:
        core = read_mesh(dentin)
        core.require_solid(str(dentin))
        core = Mesh(core.vertices_mm - centre, core.faces)
    return Tooth(fdi, Mesh(shell.vertices_mm - centre, shell.faces), core), incisor.gums


def write_meshes(out: Path, tooth: Tooth, gums: Mesh | None) -> None:
    """Write the surfaces of a tooth or an object, and of the gums, below a capture's folder."""
    folder = teeth_folder(out, tooth.fdi)
    write_mesh(folder / "outer.ply", tooth.outer)
    if tooth.dentin is not None:
        write_mesh(folder / inner_file(tooth.fdi), tooth.dentin)
    if gums is not None:
        write_mesh(out / "gums.ply", gums)


def render_tooth(
    out: Path,
    tooth: Tooth,
    camera: Camera,
    lights: tuple[Light, ...],
    channel: int,
    tissue: Tissue,
    surface: Reflection,
    face: PhantomSurface,
    renderer: Renderer,
    samples: int,
    seed: int,
    painted: ToothStains | None = None,
) -> Stack:
    """Render one channel's light that was inside a tooth or an object, under each light."""
    prepare_device()
    if renderer == "mitsuba":
        from services.assets.mitsuba.scene import nested_scene

        folder = teeth_folder(out, tooth.fdi)
        shell, stain_textures = folder / "outer.ply", {}
        if painted is not None:
            shell = folder / "stained.ply"
            write_mapped_mesh(shell, tooth.outer, painted.corners_uv)
            stain_textures = {str(tooth.fdi): tuple(write_textures(folder, painted).values())[channel]}
        files = {str(tooth.fdi): (shell, folder / inner_file(tooth.fdi) if tooth.dentin is not None else None)}
        if not face.is_rough:
            scene = nested_scene(files, tissue, (camera,), lights[0].position_mm, 1.0, stains=stain_textures)
            return render_mitsuba(scene, lights, channel, samples, seed)
        scene, dark = (
            nested_scene(
                files, inside, (camera,), lights[0].position_mm, 1.0, boundary="rough", ior=face.ior,
                roughness=face.roughness,
            )
            for inside in (tissue, INK)
        )  # fmt: skip
        return render_mitsuba(scene, lights, channel, samples, seed, dark)
    from services.transport.engine import Engine

    recipe = single_tooth(
        outer=tooth.outer,
        dentin=None if tooth.dentin is None else DentinShape.known(tooth.dentin),
        light_positions_mm=np.array([light.position_mm for light in lights]),
        light_intensities=np.array([light.intensity[channel] for light in lights]),
        boundary=face.boundary,
        ior=face.ior,
    )
    recipe = replace(recipe, roughness=face.roughness, multiple_scattering=face.multiple_scattering)
    if painted is not None:
        recipe = replace(recipe, teeth=(replace(recipe.teeth[0], stain_uv=painted.corners_uv),))
    return render_engine(Engine(recipe), tissue, camera, surface.enamel_pixels, samples, seed)


def _truth(
    tissues: Mapping[str, Tissue],
    face: PhantomSurface,
    renderer: Renderer,
    samples: int,
    seed: int,
    highlights: bool,
    gums: bool,
) -> dict[str, Any]:
    optics = {
        name: {"enamel": medium_truth(tissue.enamel), "dentin": medium_truth(tissue.dentin)}
        for name, tissue in tissues.items()
    }
    surface = {"roughness": face.shine, "model": "GGX reflection (Walter et al. 2007)"} if highlights else None
    return face.truth() | {
        "channels": optics,
        "highlights": surface,
        "gums": gums,
        "renderer": renderer,
        "samples_per_pixel": samples,
        "seed": seed,
    }
