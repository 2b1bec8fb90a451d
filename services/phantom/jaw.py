"""A virtual jaw: a folder capture of fourteen teeth with gums and the wall of the mouth, with known optics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from services.anatomy.blend import dentin_blend_shape
from services.anatomy.dentin_shape import DentinShape
from services.anatomy.scans.scan import read_scan
from services.anatomy.scans.scanned_jaw import jaw_from_scan
from services.anatomy.templates.dimensions import upper_tooth
from services.anatomy.templates.jaw import build_jaw
from services.core.errors import MeshError
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Light, Mesh, Tooth, teeth_folder
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
from services.phantom.jaw_optics import GUMS_IOR, jaw_mouth
from services.phantom.lips import joined, lips_and_retractor
from services.phantom.render import Stack, render_engine, render_mitsuba
from services.phantom.surface import INK, IOR, PhantomSurface
from services.transport.optics.parameters import Mouth
from services.transport.platform import prepare_device
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces

Painter = Callable[[Camera, int, int], Stack]
"""Function that renders one channel's images of a camera, given the paths per pixel and a seed."""
SCAN_DENTIN = (0.3, 0.8)
"""Range of the blend weights of a scanned tooth's dentin, whose true surface is unknown."""
_DENTIN = 3
"""Stream of random numbers for dentin, different from those of the optics."""


@dataclass(frozen=True)
class JawSurfaces:
    """A jaw in its own coordinates, teeth by ascending FDI number."""

    teeth: tuple[Tooth, ...]
    gums: Mesh
    cavity: Mesh | None = None
    weights: dict[int, tuple[float, ...]] | None = None
    """Blend weights of each tooth's assumed dentin, by FDI number; None if every dentin is known."""
    lips: Mesh | None = None
    """Lips and a retractor in front of the teeth, which no scan shows."""

    @property
    def opaque(self) -> Mesh | None:
        """All opaque surfaces: the wall of the mouth, lips and retractor; None if there are none."""
        parts = [mesh for mesh in (self.cavity, self.lips) if mesh is not None]
        return joined(parts) if parts else None

    def recipe(self, lights: tuple[Light, ...], channel: int, face: PhantomSurface) -> SceneRecipe:
        """Scene of one channel for the project's engine, with fixed dentin; gums have the teeth's roughness."""
        surfaces = [
            ToothSurfaces(tooth.outer, None if tooth.dentin is None else DentinShape.known(tooth.dentin))
            for tooth in self.teeth
        ]
        positions, intensities = (
            np.array([light.position_mm for light in lights]),
            np.array([light.intensity[channel] for light in lights]),
        )
        return SceneRecipe(
            tuple(surfaces),
            positions,
            intensities,
            face.boundary,
            face.ior,
            roughness=face.roughness,
            multiple_scattering=face.multiple_scattering,
            gums=self.gums,
            gums_ior=GUMS_IOR,
            cavity=self.opaque,
        )


def jaw_surfaces(subject: int | None = None, scan: Path | None = None) -> JawSurfaces:
    """Surfaces of a subject's jaw, or of a scanned jaw with assumed dentin and without the wall of the mouth.

    Args:
        subject: None for the average; a number draws sizes and stances, and for a scanned jaw only the dentin.
        scan: labelled scan of a jaw; None for an average jaw.

    Raises:
        CaptureInputError: the scan cannot be read. MeshError: a part of it cannot be closed.
    """
    if scan is None:
        jaw = build_jaw(subject)
        teeth = sorted(
            (Tooth(tooth.fdi, tooth.outer, tooth.dentin) for tooth in jaw.teeth), key=lambda tooth: tooth.fdi
        )
        return JawSurfaces(tuple(teeth), jaw.gums, jaw.cavity)
    scanned = jaw_from_scan(read_scan(scan))
    teeth, weights = [], {}
    for tooth, frame in zip(scanned.teeth, scanned.frames, strict=True):
        middle = sum(SCAN_DENTIN) / 2
        c = (
            (middle,) * 3
            if subject is None
            else tuple(np.random.default_rng((subject, _DENTIN, tooth.fdi)).uniform(*SCAN_DENTIN, 3).tolist())
        )
        try:
            shape = dentin_blend_shape(tooth.outer, frame, crown=upper_tooth(tooth.fdi % 10))
        except MeshError:
            # Make a crown that is too thin for any dentin of enamel alone.
            teeth.append(tooth)
            continue
        teeth.append(replace(tooth, dentin=Mesh(shape.vertices_mm(c), shape.base.faces)))
        weights[tooth.fdi] = c
    return JawSurfaces(tuple(sorted(teeth, key=lambda tooth: tooth.fdi)), scanned.gums, weights=weights)


def write_jaw_phantom(
    out: Path,
    *,
    subject: int | None = None,
    scan: Path | None = None,
    pixel_mm: float = 1.0,
    cameras: int = 3,
    lights: int = 8,
    held_out: int | None = None,
    channels: int = 1,
    boundary: Boundary = "matched",
    ior: float = IOR,
    roughness: float = DEFAULT_ROUGHNESS,
    multiple_scattering: bool = True,
    seed: int = 1,
    samples: int = 1024,
    renderer: Renderer = "engine",
    lips: bool = False,
) -> None:
    """Write a folder capture (``capture.json``, images with variance, ``teeth/``, ``gums.ply``, ``cavity.ply``) and
    ``truth.json`` with its optics.

    Args:
        out: folder to write.
        subject: seed of a subject's sizes, stances and optics; None for the average.
        scan: a labelled scan (.vtp or .ply) from which teeth and gums are taken; None for an average jaw.
        pixel_mm: size of a pixel in the jaw's middle.
        cameras, lights: numbers of cameras and lights.
        held_out: number of lights that are marked as held out; default every fourth.
        channels: 1 (green) or 3 (red, green, blue).
        boundary: model of the outer boundary of teeth and gums.
        ior, roughness, multiple_scattering: of the teeth's surface, see ``PhantomSurface``; gums have the same
            roughness, and an index of their own.
        seed: seed of the rendering and of the lights' brightness.
        samples: paths per pixel.
        renderer: the project's engine, or stock Mitsuba for a matched or rough boundary and teeth that do not overlap.
        lips: put lips and a retractor in front of the teeth, which cast shadows. A capture does not contain their
            surface; it is in ``truth_lips.ply``.

    Raises:
        InputError: the combination of options is impossible. CaptureInputError: the scan cannot be read. MeshError: a
            surface cannot bound a medium.
    """
    face = PhantomSurface(boundary, ior, roughness, multiple_scattering)
    require_rig(pixel_mm, cameras, lights, channels, samples, held_out, face, renderer)
    jaw, names = jaw_surfaces(subject, scan), CHANNELS[channels]
    if lips:
        jaw = replace(jaw, lips=lips_and_retractor([tooth.outer for tooth in jaw.teeth]))
    rig_lights = dome_lights(lights, names, seed)
    rig_cameras = dome_cameras(cameras, pixel_mm, tuple(tooth.outer for tooth in jaw.teeth))
    mouths = {name: known_mouth(jaw, name, subject) for name in names}
    write_jaw_meshes(out, jaw)
    if jaw.lips is not None:
        write_mesh(out / "truth_lips.ply", jaw.lips)

    entries, held_out_indices = [], held_out_lights(lights, held_out)
    with TemporaryDirectory() as folder:
        painters = (
            _by_mitsuba(jaw, mouths, rig_lights, face, Path(folder))
            if renderer == "mitsuba"
            else _by_engine(jaw, mouths, rig_lights, face)
        )
        for number, camera in enumerate(rig_cameras):
            stacks = [paint(camera, samples, seed + 7919 * number) for paint in painters]
            mean, variance = (np.stack([stack[k] for stack in stacks], axis=-1) for k in range(2))
            entries += write_images(out, camera, rig_lights, mean, variance, held_out_indices)
    settings = {
        "subject": subject,
        "scan": None if scan is None else scan.name,
        "renderer": renderer,
        "samples_per_pixel": samples,
        "seed": seed,
    }
    write_description(out, names, rig_cameras, rig_lights, entries, jaw_truth(jaw, mouths, face) | settings)


def write_jaw_meshes(out: Path, jaw: JawSurfaces) -> None:
    """Write ``teeth/<FDI>/outer.ply`` and ``dentin.ply``, ``gums.ply`` and ``cavity.ply``."""
    for tooth in jaw.teeth:
        folder = teeth_folder(out, tooth.fdi)
        write_mesh(folder / "outer.ply", tooth.outer)
        if tooth.dentin is not None:
            write_mesh(folder / "dentin.ply", tooth.dentin)
    write_mesh(out / "gums.ply", jaw.gums)
    if jaw.cavity is not None:
        write_mesh(out / "cavity.ply", jaw.cavity)


def jaw_truth(jaw: JawSurfaces, mouths: dict[str, Mouth], face: PhantomSurface) -> dict[str, Any]:
    """True optics for ``truth.json``, by channel and FDI number."""
    return {
        **face.truth(),
        "gums_ior": 1.0 if face.boundary == "matched" else GUMS_IOR,
        "channels": {name: _channel_truth(jaw, mouth) for name, mouth in mouths.items()},
        "dentin_shape": jaw.weights and {str(fdi): list(weights) for fdi, weights in jaw.weights.items()},
    }


def _channel_truth(jaw: JawSurfaces, mouth: Mouth) -> dict[str, Any]:
    assert mouth.gums is not None
    teeth = {}
    for tooth, tissue in zip(jaw.teeth, mouth.teeth, strict=True):
        teeth[str(tooth.fdi)] = {"enamel": medium_truth(tissue.enamel)} | (
            {} if tooth.dentin is None else {"dentin": medium_truth(tissue.dentin)}
        )
    return {"teeth": teeth, "gums": medium_truth(mouth.gums), "cavity_reflectance": mouth.reflectance}


def known_mouth(jaw: JawSurfaces, channel: str, subject: int | None) -> Mouth:
    """True media of a subject in one channel, in the order of the jaw's teeth."""
    mouth = jaw_mouth([tooth.fdi for tooth in jaw.teeth], channel, subject)
    return mouth if jaw.opaque is not None else replace(mouth, reflectance=None)


def _by_engine(
    jaw: JawSurfaces, mouths: dict[str, Mouth], lights: tuple[Light, ...], face: PhantomSurface
) -> list[Painter]:
    from services.transport.engine import Engine

    def painter(channel: int, mouth: Mouth) -> Painter:
        engine = Engine(jaw.recipe(lights, channel, face))
        return lambda camera, samples, seed: render_engine(
            engine, mouth, camera, np.ones(camera.size[::-1], dtype=bool), samples, seed
        )

    return [painter(channel, mouth) for channel, mouth in enumerate(mouths.values())]


def _by_mitsuba(
    jaw: JawSurfaces, mouths: dict[str, Mouth], lights: tuple[Light, ...], face: PhantomSurface, folder: Path
) -> list[Painter]:
    from services.assets.mitsuba.mouth_scene import mouth_scene, write_mouth_surfaces

    prepare_device()
    files, fdi = write_mouth_surfaces(folder, jaw.teeth, jaw.gums, jaw.opaque), tuple(tooth.fdi for tooth in jaw.teeth)

    def painter(channel: int, mouth: Mouth) -> Painter:
        # What black teeth, gums and wall show is the highlights.
        ink = Mouth((INK,) * len(fdi), INK.enamel, None if mouth.reflectance is None else 0.0)

        def paint(camera: Camera, samples: int, seed: int) -> Stack:
            scene, dark = (
                mouth_scene(
                    files, fdi, shown, (camera,), lights[0].position_mm, 1.0, boundary=face.boundary, ior=face.ior,
                    gums_ior=GUMS_IOR, roughness=face.roughness,
                )
                for shown in (mouth, ink)
            )  # fmt: skip
            return render_mitsuba(scene, lights, channel, samples, seed, dark if face.is_rough else None)

        return paint

    return [painter(channel, mouth) for channel, mouth in enumerate(mouths.values())]
