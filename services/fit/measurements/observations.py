"""Inputs of a fit from the prepared stage: its measurements, their weights, and their partition into blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.neighbours import read_neighbours
from services.core.errors import CaptureInputError, SettingsError
from services.core.files.content_files import StoredFile
from services.core.files.meshes import read_mesh, read_teeth
from services.core.geometry import Mesh, Tooth
from services.core.records import JobSpec, Loss, MaskBit
from services.core.results import PreparedManifest, RoughSurface
from services.core.store import open_stage
from services.fit.coordinates.instrument_errors import NO_ERRORS, InstrumentErrors
from services.fit.measurements.blocks import PixelBlock, split_pixels, write_block
from services.fit.measurements.held_out import held_out_images, left_out_lights
from services.fit.measurements.instrument.capture import Instrument
from services.fit.measurements.instrument.moves import Move
from services.fit.measurements.levels import LevelReader, reduced_camera, whole_squares
from services.fit.measurements.pixel_step import chosen_pixel_step
from services.fit.measurements.slopes import image_slopes
from services.fit.measurements.smooth_functions import smooth_functions
from services.fit.measurements.view_stack import ViewStack, comparison_cells, on_coarse_grid
from services.fit.solve.losses import first_weights
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces, View
from services.transport.scene.recipe_files import write_recipe

Array = NDArray[np.float64]

COARSE_PIXELS = 600
"""Largest number of pixels of a view, for each of its teeth, in all stages but the last, and in the evaluations after
each step."""
SEARCH_PIXELS = 210
"""Number of pixels, over all views, that the table search compares."""


@dataclass(frozen=True)
class Observations:
    """Content of the prepared stage."""

    folder: Path
    manifest: PreparedManifest
    teeth: tuple[Tooth, ...]
    held_out: NDArray[np.bool_]
    """Mask (camera, light) of the held-out images."""
    gums: Mesh | None = None
    cavity: Mesh | None = None
    neighbours: tuple[Tooth, ...] = ()
    """Teeth that are rendered around a single one, the nearest first."""
    pixel_step: int = 1
    """Edge of the fitted squares, in pixels of the photographs."""

    @property
    def pixel_edge_mm(self) -> float:
        """Median over cameras of the edge of a fitted square at the teeth."""
        centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in self.teeth]).mean(axis=0)
        return self.pixel_step * float(np.median([camera.pixel_mm(centre_mm) for camera in self.manifest.cameras]))

    @property
    def light_positions_mm(self) -> Array:
        """Positions (L, 3) of the lights, in mm."""
        return np.array([light.position_mm for light in self.manifest.lights])

    def light_intensities(self, channel: str) -> Array:
        """Radiant intensities (L,) of the lights in a channel; a light with a single intensity has it in
        all channels.
        """
        index = self.manifest.channels.index(channel)
        return np.array([light.intensity[index if len(light.intensity) > 1 else 0] for light in self.manifest.lights])


@dataclass(frozen=True)
class Level:
    """One resolution of a channel's images."""

    blocks: tuple[StoredFile, ...]
    """Blocks under the fitted lights."""
    evaluation_blocks: tuple[StoredFile, ...]
    """Blocks under all lights with a valid pixel."""
    pixels: int
    """Number of fitted pixels in all views."""
    signal: float
    """sum weight ref^2 over fitted measurements; the relative loss is the loss divided by it."""


@dataclass(frozen=True)
class ChannelFiles:
    """Blocks and scenes of one channel on disk."""

    channel: str
    recipe: StoredFile
    coarse: Level
    """Every n-th pixel in x and y, so that no view has more than ``COARSE_PIXELS`` fitted pixels for each of
    its teeth."""
    full: Level
    search_blocks: tuple[StoredFile, ...]
    """A few pixels of each view under the fitted lights."""
    evaluation_recipe: StoredFile
    weight: float
    """Mean weight of a fitted measurement."""
    quality: float
    """Signal-to-noise power over fitted measurements."""
    errors: InstrumentErrors = NO_ERRORS
    """Errors of the instrument that act on the fitted photographs."""
    moves: tuple[Move, ...] = ()
    """Moves of scan and dome, which the standard errors include."""

    @property
    def blocks(self) -> tuple[StoredFile, ...]:
        """Blocks of full resolution, fitted or evaluated."""
        return self.full.blocks + self.full.evaluation_blocks


def read_observations(root: Path, spec: JobSpec) -> Observations:
    """Open and check the prepared stage.

    Raises:
        CaptureInputError, SettingsError: the job cannot be fitted to the capture; the message names the cause and the
            remedy.
    """
    folder, manifest = open_stage(root, "prepared", PreparedManifest)
    if spec.kind == "tooth" and len(manifest.fdi) != 1:
        raise CaptureInputError(
            f"A tooth fit needs one tooth and the capture has {len(manifest.fdi)} ({manifest.fdi}); name one by the"
            " option 'fdi', or set kind to 'jaw'."
        )
    if spec.kind == "jaw" and len(manifest.fdi) < 2:
        raise CaptureInputError(
            "A jaw fit needs at least two teeth and the capture has one; add a folder below teeth/ for each, or set"
            " kind to 'tooth'."
        )
    teeth = read_teeth(folder, manifest.fdi)
    if spec.dentin == "known" and not any(tooth.dentin is not None for tooth in teeth):
        owner = f"tooth {teeth[0].fdi}" if len(teeth) == 1 else "no tooth"
        raise SettingsError(
            f"dentin = 'known' but {owner} has {'no' if len(teeth) == 1 else 'a'} dentin.ply; add it, or set dentin to"
            " 'fit' or 'none'."
        )
    for channel in spec.channels or ():
        if channel not in manifest.channels:
            raise SettingsError(
                f"Option channels names '{channel}', which the capture does not have; it has"
                f" {', '.join(manifest.channels)}."
            )
    held_out = held_out_images(manifest, spec)
    centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in teeth]).mean(axis=0)
    step = chosen_pixel_step(folder, manifest, centre_mm, spec)
    if spec.kind != "jaw" and not manifest.surroundings:
        return Observations(folder, manifest, teeth, held_out, pixel_step=step)
    gums, cavity = (
        read_mesh(path) if path.is_file() else None for path in (folder / "gums.ply", folder / "cavity.ply")
    )
    if spec.kind == "tooth":
        neighbours = read_neighbours(folder, teeth[0])
        return Observations(folder, manifest, teeth, held_out, gums, neighbours=neighbours, pixel_step=step)
    return Observations(folder, manifest, teeth, held_out, gums, cavity, pixel_step=step)


def read_channel(observations: Observations, channel: str, spec: JobSpec) -> tuple[ViewStack, ...]:
    """Valid pixels of one channel in every camera, at the resolution of the fit.

    Raises:
        CaptureInputError: no valid pixel, or no light in them.
    """
    manifest, index = observations.manifest, observations.manifest.channels.index(channel)
    step = observations.pixel_step
    level = LevelReader(observations.folder / "prepared.zarr", index, step)
    lights, views, used = range(len(manifest.lights)), [], ~left_out_lights(manifest, spec)[:, None, None]
    for c, camera in enumerate(manifest.cameras):
        valid = np.stack([whole_squares(level.bits(c, light, camera) == 0, step) for light in lights]) & used
        y, x = np.nonzero(valid.any(axis=0))
        if len(x) == 0:
            continue
        outside = np.uint16(MaskBit.OUTSIDE)
        usable = (whole_squares(level.bits(c, light, camera) & ~outside == 0, step) for light in lights)
        images = ((*level.image(c, light, camera), seen) for light, seen in zip(lights, usable, strict=True))
        reference, spread, slopes = (
            np.stack(one)
            for one in zip(
                *((radiance[y, x], own[y, x], image_slopes(radiance, seen)[:, y, x]) for radiance, own, seen in images),
                strict=True,
            )
        )
        chosen = valid[:, y, x] & np.isfinite(reference)
        reference = np.where(chosen, reference, 0.0)
        assumed = (spec.sensor_noise_relative * reference) ** 2 + (
            spec.sensor_noise_floor * reference.max(initial=0.0)
        ) ** 2
        known = np.isfinite(spread) & (spread > 0)
        pixels = np.stack([x, y], axis=-1).astype(np.int32)
        reduced = reduced_camera(camera, step)
        views.append(
            ViewStack(
                reduced,
                pixels,
                reference,
                np.where(known, spread, assumed),
                chosen,
                observations.held_out[c],
                slopes=np.where(chosen, slopes.swapaxes(0, 1), 0.0),
            )
        )
    if not views:
        raise CaptureInputError(
            "No pixel is valid in any image; check the masks, and that meshes and cameras share one frame in"
            " millimetres."
        )
    require_signal(views, f"Channel {channel}")
    if observations.held_out.any() and not any((v.valid & v.held_out[:, None]).any() for v in views):
        raise CaptureInputError(
            "No pixel is valid in any held-out image; name others in held_out_lights or held_out_cameras."
        )
    return tuple(views)


def require_signal(views: Sequence[ViewStack], name: str) -> None:
    """Refuse views without a signal to fit.

    Raises:
        CaptureInputError: no valid pixel, or no light in them.
    """
    fitted = [v.fitted for v in views]
    if not any(f.any() for f in fitted):
        raise CaptureInputError(
            "No pixel is valid in any fitted image; name fewer in held_out_lights or held_out_cameras, or check the"
            " masks."
        )
    signal = sum(float((v.reference[f] ** 2 - v.variance[f]).sum()) for v, f in zip(views, fitted, strict=True))
    if signal <= 0:
        raise CaptureInputError(
            f"{name} is dark: no signal above its noise in any fitted image; check exposure and lights, or leave it"
            " out."
        )


def channel_scene(
    observations: Observations,
    channel: str,
    dentins: Sequence[DentinShape | None],
    spec: JobSpec,
    stain_uv: Array | None = None,
    neighbours: tuple[ToothSurfaces, ...] = (),
    surface: RoughSurface | None = None,
) -> SceneRecipe:
    """Scene recipe of the capture, with the dentin of each tooth, under all lights of a channel.

    Args:
        surface: of boundary ``rough``, the surface that the fit holds.
    """
    return SceneRecipe(
        tuple(
            ToothSurfaces(tooth.outer, dentin, stain_uv)
            for tooth, dentin in zip(observations.teeth, dentins, strict=True)
        ),
        observations.light_positions_mm,
        observations.light_intensities(channel),
        spec.boundary,
        spec.ior,
        spec.device,
        gums=observations.gums,
        cavity=observations.cavity,
        neighbours=neighbours,
    ).with_surface(surface)


def write_channel(
    folder: Path,
    scene: SceneRecipe,
    channel: str,
    views: tuple[ViewStack, ...],
    loss: Loss = "l2",
    instrument: Instrument | None = None,
) -> ChannelFiles:
    """Write one channel's blocks and scenes; the same input gives the same files.

    Args:
        folder: receives the files.
        scene: scene under all lights, in the order of the views' images.
        channel: name of the channel.
        views: observed views.
        loss: the fitted loss.
        instrument: the instrument; None for one without errors.
    """
    fitted = [v.fitted for v in views]
    fitted_lights = np.any([f.any(axis=1) for f in fitted], axis=0)
    valid_lights = np.any([v.valid.any(axis=1) for v in views], axis=0)
    noise = np.concatenate([v.variance[f] for v, f in zip(views, fitted, strict=True)])
    values = np.concatenate([v.reference[f] for v, f in zip(views, fitted, strict=True)])
    weight = first_weights(loss, values, noise)
    by_view = np.split(weight, np.cumsum([f.sum() for f in fitted])[:-1])
    weights = [np.zeros(v.reference.shape) for v in views]
    for whole, f, part in zip(weights, fitted, by_view, strict=True):
        whole[f] = part

    coarse_pixels = COARSE_PIXELS * len(scene.teeth)
    cells = {v.camera.name: comparison_cells(v, coarse_pixels) for v in views}
    brightest = {v.camera.name: float(np.where(v.valid, v.reference, 0.0).max(initial=0.0)) for v in views}
    fitted_cameras = [v.camera.name for v, f in zip(views, fitted, strict=True) if f.any()]

    moved = dict(
        zip(cells, [None] * len(views) if instrument is None else instrument.motions(scene, views), strict=True)
    )

    def under(lights: NDArray[np.bool_]) -> SceneRecipe:
        return replace(
            scene,
            light_positions_mm=scene.light_positions_mm[lights],
            light_intensities=scene.light_intensities[lights],
        )

    def block(view: ViewStack, weight: Array, lights: NDArray[np.bool_], pixels: NDArray[np.int64]) -> StoredFile:
        cut = np.ix_(np.flatnonzero(lights), pixels)
        held_out = view.valid[cut] & view.held_out[lights][:, None]
        measured = View(view.camera, view.pixels[pixels]), view.reference[cut], view.variance[cut]
        parts = None if view.parts is None else view.parts.of(pixels)
        instrument_of_block = (
            None
            if instrument is None
            else instrument.block_instrument(channel, view.camera.name, brightest[view.camera.name], lights)
        )
        motion = None if (of_view := moved[view.camera.name]) is None else of_view.of(lights, pixels)
        cell = cells[view.camera.name][pixels]
        functions = smooth_functions(view.pixels[pixels]) if scene.boundary == "rough" else None
        block = PixelBlock(*measured, weight[cut], held_out, parts, cell, instrument_of_block, motion, functions)
        return write_block(folder, block)

    def level(max_pixels: int | None) -> Level:
        fits, compares, pixels, signal = list[StoredFile](), list[StoredFile](), 0, 0.0
        for view, weight, fit in zip(views, weights, fitted, strict=True):
            counted = np.asarray(fit.any(axis=0))
            kept = (
                np.ones(len(view.pixels), dtype=bool)
                if max_pixels is None
                else on_coarse_grid(view.pixels, counted, max_pixels)
            )
            relevant = np.flatnonzero(counted & kept)
            pixels, signal = pixels + len(relevant), signal + float((weight * view.reference**2)[:, kept].sum())
            fits += [
                block(view, weight, fitted_lights, part)
                for part in split_pixels(relevant, int(fitted_lights.sum()), len(views))
                if len(part)
            ]
            valid_pixels = np.flatnonzero(view.valid.any(axis=0) & kept)
            compares += [
                block(view, weight, valid_lights, part)
                for part in split_pixels(valid_pixels, int(valid_lights.sum()), len(views))
                if len(part)
            ]
        return Level(tuple(fits), tuple(compares), pixels, signal)

    search_pixels = [_spread(np.flatnonzero(fit.any(axis=0)), SEARCH_PIXELS // len(views)) for fit in fitted]
    return ChannelFiles(
        channel=channel,
        recipe=write_recipe(folder, under(fitted_lights)),
        coarse=level(coarse_pixels),
        full=level(None),
        search_blocks=tuple(
            block(view, weight, fitted_lights, pixels)
            for view, weight, pixels in zip(views, weights, search_pixels, strict=True)
            if len(pixels)
        ),
        evaluation_recipe=write_recipe(folder, under(valid_lights)),
        weight=float(weight.mean()),
        quality=float(values @ values / noise.sum()),
        errors=NO_ERRORS if instrument is None else instrument.errors(channel, fitted_cameras, fitted_lights),
        moves=() if instrument is None else instrument.moves(folder, under(fitted_lights)),
    )


def _spread(pixels: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    # Choose pixels evenly over the raster order.
    return pixels[np.unique(np.linspace(0, len(pixels) - 1, max(count, 1)).astype(int))] if len(pixels) else pixels
