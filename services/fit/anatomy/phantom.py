"""A virtual mouth: a folder capture of a tooth with known optics, for tests, demonstrations and the simulated cameras."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.core.geometry import Camera, Light, Mesh, Tooth, teeth_folder
from services.core.meshfiles import read_mesh, write_mesh
from services.core.records import Boundary, FolderCapture, ImageEntry
from services.core.store import write_atomic, write_record
from services.fit.anatomy.incisor import build_incisor
from services.fit.anatomy.reflection import ROUGHNESS, Reflection, reflect
from services.fit.anatomy.rig import dome_cameras, dome_lights
from services.fit.anatomy.subjects import subject_tissues
from services.fit.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from services.fit.transport.platform import prepare_device
from services.fit.transport.recipe import DentinShape, View, single_tooth

FDI = 11
IOR = 1.631
CHANNELS = {1: ("green",), 3: ("red", "green", "blue")}
TRUE_TISSUE = {
    "red": Tissue(Medium(4.2, 0.9980, g1=0.80), Medium(11.0, 0.9965, g1=0.75)),
    "green": Tissue(Medium(4.5, 0.9970, g1=0.80), Medium(12.0, 0.9945, g1=0.75)),
    "blue": Tissue(Medium(5.0, 0.9955, g1=0.80), Medium(13.0, 0.9905, g1=0.75)),
}
"""Absorption rises towards blue, dentin's faster: the yellow of teeth. Within the literature's spread."""
HELD_OUT_EVERY = 4

Renderer = Literal["engine", "mitsuba"]
Stack = tuple[NDArray[np.float64], NDArray[np.float64]]


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
    renderer: Renderer = "engine",
    highlights: bool = False,
    gums: bool = False,
    subject: int | None = None,
) -> None:
    """Write a folder capture (``capture.json``, images with variance, ``teeth/11``) and ``truth.json`` with its optics.

    Every fourth light is marked as held out.

    Args:
        pixel_mm: size of a pixel at the tooth.
        channels: 1 (green) or 3 (red, green, blue).
        samples: paths per pixel.
        outer: another tooth's enamel surface, in the canonical frame (x mesial, y buccal, z occlusal) or near it; default the procedural incisor.
        dentin: its dentin surface, given with ``outer``.
        renderer: the project's engine, or stock Mitsuba for boundary ``matched``.
        highlights: add the surface's reflection of each light; also written alone to ``highlights/<camera>_<light>.npy``.
        gums: cover the root with gums, drawn as an opaque diffuse surface that exchanges no light with the tooth; also written as ``gums.ply``.
        subject: seed of a random subject's optics; None for those of ``TRUE_TISSUE``.

    Raises:
        InputError: impossible combination of options.
    """
    _require_possible(pixel_mm, cameras, lights, channels, samples, boundary, outer, dentin, renderer, highlights, gums)
    tooth, collar = _tooth(outer, dentin)
    shown_gums = collar if gums else None
    names = CHANNELS[channels]
    tissues = TRUE_TISSUE if subject is None else subject_tissues(subject, names)
    rig_lights = dome_lights(lights, names, seed)
    rig_cameras = dome_cameras(cameras, pixel_mm, (tooth.outer,))
    _write_meshes(out, tooth, shown_gums)

    entries = []
    for number, camera in enumerate(rig_cameras):
        surface = reflect(tooth.outer, shown_gums, camera, rig_lights, names, IOR)
        stacks = [
            _render(out, tooth, camera, rig_lights, c, tissues[name], surface, boundary, renderer, samples, seed + 7919 * number)
            for c, name in enumerate(names)
        ]
        mean, variance = (np.stack([stack[k] for stack in stacks], axis=-1) for k in range(2))
        share = surface.enamel_share[None, ..., None]
        mean, variance = mean * share + surface.gums, variance * share**2
        if highlights:
            mean = mean + surface.highlight
        for n, light in enumerate(rig_lights):
            stem = f"{camera.name}_{light.name}"
            _write_image(out / f"{stem}.npy", mean[n])
            _write_image(out / f"{stem}_var.npy", variance[n])
            if highlights:
                _write_image(out / "highlights" / f"{stem}.npy", surface.highlight[n])
            held_out = n % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
            entries.append(ImageEntry(camera=camera.name, light=light.name, file=f"{stem}.npy", variance_file=f"{stem}_var.npy", held_out=held_out))
    truth = _truth({name: tissues[name] for name in names}, boundary, renderer, samples, seed, highlights, gums)
    write_atomic(out / "truth.json", (json.dumps(truth, indent=1) + "\n").encode())
    write_record(out / "capture.json", FolderCapture(units="mm", channels=names, cameras=rig_cameras, lights=rig_lights, images=tuple(entries)))


def _require_possible(
    pixel_mm: float,
    cameras: int,
    lights: int,
    channels: int,
    samples: int,
    boundary: Boundary,
    outer: Path | None,
    dentin: Path | None,
    renderer: Renderer,
    highlights: bool,
    gums: bool,
) -> None:
    if min(cameras, lights) < 1 or samples < 16 or not pixel_mm > 0:
        raise InputError("A phantom needs at least one camera, one light, 16 samples and a positive pixel size; raise the one that is too small.")
    if channels not in CHANNELS:
        raise InputError(f"A phantom has 1 or 3 channels, not {channels}; choose one of these.")
    if dentin is not None and outer is None:
        raise InputError("A dentin mesh was given without its enamel's outer mesh; give both.")
    if outer is not None and gums:
        raise InputError("Gums are made for the procedural incisor only; leave out either the gums or the outer mesh.")
    if renderer == "mitsuba" and boundary != "matched":
        raise InputError(f"Stock Mitsuba has no {boundary} boundary; choose renderer engine or boundary matched.")
    if highlights and boundary == "matched":
        raise InputError("An index-matched surface has no highlights; choose boundary thin or leave the highlights out.")


def _tooth(outer: Path | None, dentin: Path | None) -> tuple[Tooth, Mesh]:
    # Other people's meshes are moved to the origin: single precision is best there.
    incisor = build_incisor()
    if outer is None:
        return Tooth(FDI, incisor.outer, incisor.dentin), incisor.gums
    shell = read_mesh(outer)
    shell.require_solid(str(outer))
    centre = (shell.vertices_mm.min(axis=0) + shell.vertices_mm.max(axis=0)) / 2
    core = None
    if dentin is not None:
        core = read_mesh(dentin)
        core.require_solid(str(dentin))
        core = Mesh(core.vertices_mm - centre, core.faces)
    return Tooth(FDI, Mesh(shell.vertices_mm - centre, shell.faces), core), incisor.gums


def _write_meshes(out: Path, tooth: Tooth, gums: Mesh | None) -> None:
    folder = teeth_folder(out, tooth.fdi)
    write_mesh(folder / "outer.ply", tooth.outer)
    if tooth.dentin is not None:
        write_mesh(folder / "dentin.ply", tooth.dentin)
    if gums is not None:
        write_mesh(out / "gums.ply", gums)


def _render(
    out: Path,
    tooth: Tooth,
    camera: Camera,
    lights: tuple[Light, ...],
    channel: int,
    tissue: Tissue,
    surface: Reflection,
    boundary: Boundary,
    renderer: Renderer,
    samples: int,
    seed: int,
) -> Stack:
    """Radiance (L, H, W) from inside the tooth, and the variance of its mean."""
    prepare_device()
    if renderer == "mitsuba":
        return _render_mitsuba(out, tooth, camera, lights, channel, tissue, samples, seed)
    from services.fit.transport.engine import Engine

    recipe = single_tooth(
        outer=tooth.outer,
        dentin=None if tooth.dentin is None else DentinShape(tooth.dentin, np.zeros((0, len(tooth.dentin.vertices_mm), 3))),
        light_positions_mm=np.array([light.position_mm for light in lights]),
        light_intensities=np.array([light.intensity[channel] for light in lights]),
        boundary=boundary,
        ior=IOR,
    )
    pixels = np.argwhere(surface.enamel_pixels)[:, ::-1].astype(np.int32)
    estimate = Engine(recipe).images(tissue, View(camera, pixels), samples=samples, seed=seed)
    width, height = camera.size
    images = np.zeros((2, len(lights), height, width))
    # Single estimates of almost no light may come out below zero; a photograph's cannot.
    images[:, :, pixels[:, 1], pixels[:, 0]] = np.maximum(estimate.mean, 0.0), estimate.variance
    return images[0], images[1]


def _render_mitsuba(out: Path, tooth: Tooth, camera: Camera, lights: tuple[Light, ...], channel: int, tissue: Tissue, samples: int, seed: int) -> Stack:
    import mitsuba as mi

    from services.fit.export.mitsuba_scene import load_scene, nested_scene, render_batches

    folder = teeth_folder(out, tooth.fdi)
    inner = folder / "dentin.ply" if tooth.dentin is not None else None
    scene = load_scene(nested_scene({str(tooth.fdi): (folder / "outer.ply", inner)}, tissue, (camera,), lights[0].position_mm, 1.0))
    params = mi.traverse(scene)
    images = []
    for n, light in enumerate(lights):
        params["light.position"] = mi.Point3f(*light.position_mm)
        params["light.intensity.value"] = mi.Float(light.intensity[channel])
        params.update()
        images.append(render_batches(scene, 0, samples, seed + n))
    return np.stack([image[0] for image in images]), np.stack([image[1] for image in images])


def _write_image(path: Path, image: NDArray[np.float64]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, image.astype(np.float32))


def _truth(tissues: Mapping[str, Tissue], boundary: Boundary, renderer: Renderer, samples: int, seed: int, highlights: bool, gums: bool) -> dict[str, Any]:
    optics = {
        name: {
            part: {field: getattr(medium, field) for field in MEDIUM_FIELDS}
            | {"sigma_s_reduced": medium.sigma_s_reduced, "alpha_reduced": medium.alpha_reduced}
            for part, medium in parts
        }
        for name, parts in ((name, (("enamel", tissue.enamel), ("dentin", tissue.dentin))) for name, tissue in tissues.items())
    }
    surface = {"roughness": ROUGHNESS, "model": "GGX reflection (Walter et al. 2007)"} if highlights else None
    return {
        "boundary": boundary,
        "ior": IOR if boundary == "thin" else 1.0,
        "channels": optics,
        "highlights": surface,
        "gums": gums,
        "renderer": renderer,
        "samples_per_pixel": samples,
        "seed": seed,
    }
