"""One tooth rendered by Cycles from its asset, and by stock Mitsuba from the same surfaces and numbers."""

from __future__ import annotations

import runpy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from services.assets.asset import write_asset
from services.assets.blender.scripts import write_scripts
from services.assets.mitsuba.dielectric import as_dielectric
from services.assets.mitsuba.scene import load_scene, nested_scene
from services.core.geometry import Camera, Light, Mesh, Tooth
from services.core.records import Boundary
from services.core.results import Estimate, FitReport, RoughSurface
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from services.transport.scene.stain_uv import ToothStains
from tests.support.clients import run_client

Array = NDArray[np.float64]
IOR = 1.631
LAMP = Light(name="l0", position_mm=(150.0, 600.0, 250.0), intensity=(1e6, 1e6, 1e6))
WIDE_LAMP_DEG = (40.0, 50.0)
"""Angles from the middle of a wide lamp at which its radiance begins to fall from 1, and is that of the room."""
ROOM = 0.05
"""Radiance from all other directions; stock Mitsuba gives NaN for single paths where a picture is black."""
WIDE_LAMP = "wide_lamp.exr"
"""Name of its picture, an environment, in an asset's folder."""
WIDE_LAMP_ROWS = 128
"""Height of that picture, pixels, which renderers interpolate: its edge is seven of them wide."""
CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class Case:
    """A tooth, its numbers by channel, a camera, and what lights it."""

    outer: Mesh
    dentin: Mesh | None
    tissues: tuple[Tissue, ...]
    camera: Camera
    lit_by: Literal["sky", "lamp", "wide lamp"] = "sky"
    """A wide lamp is far away in the direction of ``lamp``: light that scattered inside finds it by chance too, so that
    its pictures need less than half of the paths that a point needs."""
    boundary: Boundary = "matched"
    roughness: float = 0.15
    """Of boundary ``rough``, without light that meets several facets, which stock Mitsuba loses."""
    glass: dict[str, Any] | None = None
    """Mitsuba's surface that replaces the thin boundary of the asset's dielectric scene, where the script is asked for
    glass; under the sky only."""
    words: tuple[str, ...] = field(default=())
    """Further options of the script."""
    lamp: Light = LAMP

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, one for each tissue."""
        return CHANNELS[: len(self.tissues)]

    def covered(self) -> NDArray[np.bool_]:
        """Pixels (H, W) whose centre shows the tooth."""
        from services.transport.rays import RayScene

        width, height = self.camera.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        hits = RayScene(self.outer).first_hits(*self.camera.rays(x.ravel(), y.ravel()))
        return hits.hit.reshape(height, width)


def report_of(tissues: dict[str, Tissue], surface: RoughSurface | None = None) -> FitReport:
    """A fit's report with these numbers."""
    parameters = {
        channel: {
            f"{part}.{name}": Estimate(value=getattr(tissue.medium(part), name), se=0.01, unit="1", determined=True)
            for part in ("enamel", "dentin")
            for name in MEDIUM_FIELDS
        }
        for channel, tissue in tissues.items()
    }
    errors = dict.fromkeys(tissues, 0.03)
    return FitReport(
        converged=True, advice="", parameters=parameters, fit_error=errors, held_out_error=errors, steps=3, seconds=1.0,
        surface=surface,
    )  # fmt: skip


def write_case(folder: Path, case: Case, stains: ToothStains | None = None) -> None:
    """Write the case's asset, with the scripts for Blender."""
    surface = None
    if case.boundary == "rough":
        roughness = Estimate(value=case.roughness, se=None, unit="1", determined=False)
        surface = RoughSurface(roughness=roughness, ior=IOR, multiple_scattering=False)
    light = case.lamp.model_copy(update={"intensity": case.lamp.intensity[: len(case.tissues)]})
    write_asset(
        folder,
        report_of(dict(zip(case.channels, case.tissues, strict=True)), surface),
        (Tooth(11, case.outer, case.dentin),),
        (case.camera,),
        (light,),
        channels=case.channels,
        boundary=case.boundary,
        ior=IOR,
        stains=stains,
    )
    write_scripts(folder)
    if case.lit_by == "wide lamp":
        import mitsuba as mi

        mi.Bitmap(np.repeat(wide_lamp()[0][..., None], 3, axis=-1).astype(np.float32)).write(str(folder / WIDE_LAMP))


def wide_lamp() -> tuple[Array, float]:
    """The wide lamp as an equirectangular picture (H, 2 H), and the radiance of a perfect diffuser that faces it."""
    rows = (np.arange(WIDE_LAMP_ROWS) + 0.5) / WIDE_LAMP_ROWS
    up, around = np.pi * (0.5 - rows)[:, None], 2 * np.pi * (0.5 - (np.arange(2 * len(rows)) + 0.5) / (2 * len(rows)))
    directions = np.stack(np.broadcast_arrays(np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1)
    cosine = directions @ np.array(LAMP.position_mm) / np.linalg.norm(LAMP.position_mm)
    inner, outer = np.cos(np.radians(WIDE_LAMP_DEG))
    radiance = ROOM + (1 - ROOM) * np.clip((cosine - outer) / (inner - outer), 0.0, 1.0)
    pixel_sr = np.cos(up) * (np.pi / len(rows)) ** 2
    return radiance, float((radiance * np.maximum(cosine, 0.0) * pixel_sr).sum() / np.pi)


def cycles_image(folder: Path, case: Case, samples: int, seed: int, *words: str) -> Array:
    """Radiance (H, W, C) by the asset's script, C being the case's channels."""
    import mitsuba as mi

    picture = folder / f"cycles-{seed}.exr"
    lit: tuple[str, ...] = ("--light", case.lamp.name) if case.lit_by == "lamp" else ("--light", "none", "--sky", "1")
    if case.lit_by == "wide lamp":
        lit = (*lit, "--environment", str(folder / WIDE_LAMP))
    done = run_client(
        "bpy",
        folder / "blender" / "blender_scene.py",
        "--render",
        picture,
        "--scale",
        "1",
        "--flat",
        "--samples",
        str(samples),
        "--seed",
        str(seed),
        *lit,
        *case.words,
        *words,
    )
    assert done.returncode == 0, done.stderr
    return np.array(mi.Bitmap(str(picture)), dtype=np.float64)[..., : len(case.tissues)]


def engine_image(folder: Path, case: Case, samples: int, seed: int) -> Array:
    """Radiance (H, W, C) by the fit's path tracing, as the integrator that stock Mitsuba's scenes can take."""
    from services.transport.plugin.integrator import register_integrator

    register_integrator()
    return mitsuba_image(folder, case, samples, seed, fits=True)


def mitsuba_image(folder: Path, case: Case, samples: int, seed: int, *, fits: bool = False) -> Array:
    """Radiance (H, W, C) by stock Mitsuba's ``prbvolpath``, or by the fit's integrator; channels with the same numbers
    are rendered once.
    """
    import mitsuba as mi

    from services.transport.plugin.integrator import medium_properties

    if case.boundary == "thin":
        runpy.run_path(str(folder / "thin_boundary.py"))["register"]()
    teeth = folder / "teeth" / "11"
    files = {"11": (teeth / "outer.ply", teeth / "dentin.ply" if case.dentin is not None else None)}
    found: dict[Tissue, Array] = {}
    for k, tissue in enumerate(case.tissues):
        if tissue not in found:
            scene = nested_scene(
                files,
                tissue,
                (case.camera,),
                case.lamp.position_mm,
                case.lamp.intensity[k],
                boundary=case.boundary,
                ior=IOR,
                roughness=case.roughness,
            )
            if case.lit_by == "sky":
                scene["light"] = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
            if case.lit_by == "wide lamp":
                # The picture's top is up, its middle looks along x, and its left half along y, as Blender has it.
                turn = [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
                scene["light"] = {"type": "envmap", "filename": str(folder / WIDE_LAMP), "to_world": np.array(turn)}
            if case.glass is not None:
                scene = as_dielectric(scene)
                scene["outer_11"]["bsdf"] = case.glass
            if fits:
                media = {"enamel": tissue.enamel} | ({} if case.dentin is None else {"dentin": tissue.dentin})
                numbers = [medium_properties(part, (medium,)) for part, medium in media.items()]
                ids = {"enamel": "outer_11"} | ({} if case.dentin is None else {"dentin": "dentin_11"})
                scene["integrator"] = {"type": "dentine", "boundary": case.boundary, "ior": IOR} | ids
                for own in numbers:
                    scene["integrator"] |= own
            found[tissue] = np.array(mi.render(load_scene(scene), spp=samples, seed=17 * seed + k))[..., 0]
    return np.stack([found[tissue] for tissue in case.tissues], axis=-1).astype(np.float64)


@dataclass(frozen=True)
class Ratio:
    """Cycles ÷ Mitsuba of the mean over the tooth, by channel (C,), with its standard error from the seeds."""

    value: Array
    se: Array


def ratio_of(cycles: Array, mitsuba: Array, covered: NDArray[np.bool_]) -> Ratio:
    """Ratio of the means of images (S, H, W, C) of S seeds, over the pixels that show the tooth."""
    ours, theirs = (images[:, covered].mean(axis=1) for images in (cycles, mitsuba))
    value = ours.mean(axis=0) / theirs.mean(axis=0)
    spread = [each.std(axis=0, ddof=1) / np.sqrt(len(each)) / each.mean(axis=0) for each in (ours, theirs)]
    return Ratio(value, np.asarray(value * np.hypot(*spread)))


def ball(radius_mm: float, subdivisions: int = 4) -> Mesh:
    """A ball about the origin."""
    from tests.support.small_tooth import sphere

    return sphere(radius_mm, subdivisions)


def empty() -> Medium:
    """No medium."""
    return Medium(0.0, 0.0)
