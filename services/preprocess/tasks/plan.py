"""Plan of a preparation, made before any pixel is read: its arrays, the digest of its inputs, the held-out images."""

from __future__ import annotations

import hashlib
from pathlib import Path

from services.core.errors import SettingsError
from services.core.records import JobSpec
from services.core.store import create_array, image_pieces
from services.preprocess.masking.masks import HandMasks
from services.preprocess.stabilisation.motion import stored_step
from services.preprocess.views.source import Source

FORMAT = 10
"""Version of the prepared store and of the work files that one attempt leaves for the next. Raise it whenever either
format changes, or when the same input gives other pixels."""
OPTIONS_WITHOUT_EFFECT = frozenset({"workers", "priority", "memory_gib"})
"""Names of the options that change no pixel."""


def create_arrays(store: Path, source: Source, *, with_shadows: bool) -> None:
    """Create the arrays radiance, variance, valid and surface, and on demand shadow and motion.

    Each image has a shard of its own, so that each shard has one writer.

    Args:
        store: folder of the arrays.
        source: the capture; motion is created if it measures motion.
        with_shadows: whether to create shadow.
    """
    description = source.description
    height, width = (max(camera.size[axis] for camera in description.cameras) for axis in (1, 0))
    planes = (len(description.cameras), len(description.lights), height, width)
    channels = len(description.channels)
    stack = ("camera", "light", "y", "x")
    chunk, shard = image_pieces(height, width)
    for name in ("radiance", "variance"):
        create_array(
            store,
            name,
            (*planes, channels),
            (1, 1, *shard, channels),
            "float32",
            (*stack, "channel"),
            chunk=(1, 1, *chunk, channels),
            codec="lz4",
        )
    create_array(store, "valid", planes, (1, 1, height, width), "uint16", stack, codec="lz4")
    create_array(store, "surface", (planes[0], height, width), (1, height, width), "int16", ("camera", "y", "x"))
    if with_shadows:
        create_array(store, "shadow", planes, (1, 1, height, width), "uint8", stack)
    if not source.measures_motion:
        return
    step = stored_step((height, width))
    grid = (-(-height // step), -(-width // step))
    motion = create_array(store, "motion", (*planes[:2], *grid, 2), (1, 1, *grid, 2), "float32", (*stack, "axis"))
    motion.attrs["step_px"] = step


def digest_of_inputs(spec: JobSpec, source: Source, masks: HandMasks) -> str:
    """SHA-256 of all inputs of the store; results made with another digest cannot be resumed."""
    digest = hashlib.sha256()
    parts = [str(FORMAT), spec.model_dump_json(exclude=set(OPTIONS_WITHOUT_EFFECT)), source.identity(), masks.digest]
    for path in sorted(source.root.rglob("*.ply")):
        parts += [path.relative_to(source.root).as_posix(), hashlib.sha256(path.read_bytes()).hexdigest()]
    for part in parts:
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def held_out_images(spec: JobSpec, source: Source) -> tuple[tuple[str, str], ...]:
    """(camera, light) pairs held out from the fit: by the job's options, else the capture's marks, else every fourth
    light.

    Raises:
        SettingsError: a light or camera is unknown, or none is left to fit.
    """
    names = [light.name for light in source.description.lights]
    cameras = [camera.name for camera in source.description.cameras]
    if unknown := [name for name in spec.held_out_cameras if name not in cameras]:
        raise SettingsError(
            f"Option 'held_out_cameras' names {unknown[0]}, but the capture has {', '.join(cameras)}; correct it."
        )
    if set(spec.held_out_cameras) == set(cameras):
        raise SettingsError("Option 'held_out_cameras' keeps every camera from the fit; leave at least one to it.")
    if spec.held_out_lights is None and source.held_out and not spec.held_out_cameras:
        return source.held_out
    by_default = () if spec.held_out_cameras else tuple(names[3::4])
    chosen = spec.held_out_lights if spec.held_out_lights is not None else by_default
    if unknown := [name for name in chosen if name not in names]:
        raise SettingsError(
            f"Option 'held_out_lights' names {unknown[0]}, but the capture has {', '.join(names)}; correct it."
        )
    if set(chosen) == set(names):
        raise SettingsError("Option 'held_out_lights' keeps every light from the fit; leave at least one to it.")
    return tuple(
        (camera.name, names[j])
        for k, camera in enumerate(source.description.cameras)
        for j in source.lights_of(k)
        if names[j] in chosen or camera.name in spec.held_out_cameras
    )
