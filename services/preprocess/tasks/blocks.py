"""Blocks of work of a preparation.

Each block is one Dask task and may safely run again: ``develop`` skips images that are stored already, the other steps
make the same results anew. ::

    locate (camera) ──> match (camera, some frames) ──> develop (camera, some lights) ──> shade (camera), where shadows
    are asked for
                                                   └──> compare (camera), where motion is measured

Each image's shards are written by one block at a time.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from services.core.records import JobSpec, MaskBit
from services.core.stage import LocalContext
from services.preprocess.masking.masks import HandMasks
from services.preprocess.masking.valid import require_visible_teeth, valid_bits
from services.preprocess.opening import open_source
from services.preprocess.quality.brightness import measure_light
from services.preprocess.quality.flow import camera_flow, write_flow
from services.preprocess.quality.images import assess, by_stop, write_picture
from services.preprocess.stabilisation.motion import stored_step
from services.preprocess.tasks.attempt_files import AttemptFiles
from services.preprocess.tasks.records import FlowDone, FrameMotion, ImageDone
from services.preprocess.tasks.shade import shade
from services.preprocess.views.source import Bits, LightImage, Motions, Source, View
from services.preprocess.views.subject import NO_SURFACE, Subject, read_subject
from services.tasks.executors import Call

NO_VALUE = np.uint16(MaskBit.SATURATED | MaskBit.NOT_FINITE | MaskBit.UNLIT | MaskBit.MOTION)
"""Mask bits of pixels that are left out of an image's brightness levels and noise."""
Step = Literal["locate", "match", "compare", "develop", "shade"]
BLOCKS_PER_THREAD = 12
"""Number of blocks for each thread, high enough that no thread is idle for long at the end. Beginning a block costs too
little to be measured beside one image of 20 megapixels."""
LARGEST_BLOCK = 4
"""Largest number of images in a block, because threads are idle at the end for up to the time of one block."""


@dataclass(frozen=True)
class PreparationBlock:
    """One step for some frames or lights of one camera.

    Attributes:
        spec: description of the job.
        files: files of the attempt.
        step: step to run.
        camera: index of the camera.
        items: frame numbers for ``match``, light indices for ``develop``, else empty.
    """

    spec: JobSpec
    files: AttemptFiles
    step: Step
    camera: int
    items: tuple[int, ...] = ()

    def __call__(self) -> None:
        """Run the step; ``develop`` skips images that are stored already.

        Raises:
            CaptureInputError, StoreError: as ``Source`` and ``require_visible_teeth`` document. JobCancelledError: the
                job was cancelled. FencedError: another attempt has begun.
        """
        context = LocalContext(self.files.writer.root, self.files.writer.attempt)
        context.raise_if_cancelled()
        self.files.writer.require_lease()
        # The stage has checked them both.
        source = open_source(self.spec, context.root, verify=False)
        whole = self.spec.kind == "jaw"
        is_object = self.spec.kind == "object"
        subject = read_subject(
            source.root, whole, self.spec.fdi, self.spec.surroundings, is_object=is_object, verify=False
        )
        if self.step == "locate":
            _locate(self.files, source, subject, self.camera)
            return
        view = self.files.view(self.camera, source.description.cameras[self.camera])
        assert view is not None, "blocks that need a view wait for it"
        if self.step == "match":
            for frame, matched in source.match(view, self.items, subject.footprint_in):
                self.files.put_motion(self.camera, frame, FrameMotion.of(matched))
                context.raise_if_cancelled()
            return
        if self.step == "shade":
            shade(self.files, source, subject, view, context)
            return
        motions = self.files.motions(self.camera, source.matched_frames(self.camera))
        if self.step == "compare":
            _compare(self.files, source, view, motions)
            return
        lights = [light for light in self.items if self.files.image(self.camera, light) is None]
        writer = ImageWriter(
            self.files, source, subject, HandMasks(context.root, source.description), view, self.spec.highlights
        )
        began_s = time.monotonic()
        for light, image in source.images(view, lights, motions):
            self.files.put_image(self.camera, light, writer.store(light, image, began_s))
            context.raise_if_cancelled()
            began_s = time.monotonic()


def blocks_of(
    spec: JobSpec, files: AttemptFiles, step: Step, items: Sequence[Sequence[int]], threads: int
) -> tuple[PreparationBlock, ...]:
    """Split one step for the given frames or lights of each camera into enough blocks to keep all threads busy.

    Args:
        items: frame numbers or light indices of each camera.
        threads: number of blocks that run at once.
    """
    size = -(-sum(len(own) for own in items) // (BLOCKS_PER_THREAD * threads))
    size = min(max(size, 1), LARGEST_BLOCK)
    return tuple(
        PreparationBlock(spec, files, step, camera, tuple(own[k : k + size]))
        for camera, own in enumerate(items)
        for k in range(0, len(own), size)
    )


def block_task(_host: Any, block: PreparationBlock) -> PreparationBlock:
    """Run a block as a task, which needs no engine; returns the block."""
    block()
    return block


def calls_of(blocks: Iterable[PreparationBlock]) -> list[Call]:
    """Arguments with which an executor runs blocks."""
    return [(f"{block.step}-{block.camera}", block_task, (block,)) for block in blocks]


def images_of(block: PreparationBlock, files: AttemptFiles) -> Iterator[ImageDone]:
    """Records of the images that a block has made."""
    files.writer.require_lease()
    for light in block.items:
        done = files.image(block.camera, light)
        assert done is not None, "a block has ended once its images are stored"
        yield done


def _locate(files: AttemptFiles, source: Source, subject: Subject, camera: int) -> None:
    """Find a camera's window and footprint, and mark the lights without an image as unlit."""
    whole = source.description.cameras[camera]
    view = subject.view_of(camera, whole)
    require_visible_teeth(view.footprint, len(subject.teeth), whole)
    surface, valid = (files.array(name) for name in ("surface", "valid"))
    labels = np.full(surface.shape[1:], NO_SURFACE, dtype=np.int16)
    labels[view.window.rows, view.window.columns] = view.footprint.mesh
    surface[camera] = labels
    for light in sorted(set(range(valid.shape[1])) - set(source.lights_of(camera))):
        valid[camera, light] = np.uint16(MaskBit.UNLIT | MaskBit.OUTSIDE)
    files.put_view(view)


def _compare(files: AttemptFiles, source: Source, view: View, motions: Motions) -> None:
    """Write the pictures of optical flow before and after stabilisation."""
    comparison = source.flow_comparison(view, motions)
    flow = None if comparison is None else camera_flow(view.whole.name, comparison)
    if comparison is not None and flow is not None:
        write_flow(files.folder / "quality" / "flow", comparison, flow)
    files.put_flow(view.number, FlowDone(flow=flow))


@dataclass(frozen=True)
class ImageWriter:
    """Masks, assesses and stores the images of one camera."""

    files: AttemptFiles
    source: Source
    subject: Subject
    masks: HandMasks
    view: View
    with_highlights: bool = True
    """Whether highlights are masked."""

    def store(self, light: int, image: LightImage, began_s: float) -> ImageDone:
        """Mask one image, store it and return its record.

        Args:
            light: index of the light.
            image: the image under this light.
            began_s: monotonic time at which work on the image began.
        """
        camera, lamp = self.view.whole, self.source.description.lights[light]
        footprint, window = self.view.footprint, self.view.window
        glossy = self.subject.glossy(footprint) if self.with_highlights else ()
        bits = valid_bits(image, footprint, self.view.camera, lamp, glossy)
        bits |= self.masks.bits(camera.name, lamp.name, camera.size)[window.rows, window.columns]
        image_light = measure_light(image, self.view, lamp, (bits == 0) & (footprint.mesh < len(self.subject.teeth)))
        if image_light is not None and image_light.dark:
            bits |= np.uint16(MaskBit.UNLIT)
        self.store_masked(light, image, bits)
        picture = self.files.folder / "quality" / f"{camera.name}_{lamp.name}.png"
        write_picture(picture, image.radiance, bits)
        has_value = footprint.covered & (bits & NO_VALUE == 0)
        stops = by_stop(image.radiance, image.variance, has_value)
        moved = image.motion_px, image.motion_error_px, image.motion_source
        return ImageDone(
            quality=assess(camera.name, lamp.name, bits, footprint.covered, moved, stops),
            tooth_pixels=tuple(self.subject.pixels_of_teeth(footprint, bits).tolist()),
            light=image_light,
            colour=image.colour,
            notes=self.source.notes,
            files=self.files.files_of(self.view.number, light, picture),
            objects=self.files.objects_of(self.view.number, light),
            seconds=time.monotonic() - began_s,
        )

    def store_masked(self, light: int, image: LightImage, bits: Bits) -> None:
        """Write an image's arrays and its mask bits (H, W)."""
        image_index, window = (self.view.number, light), self.view.window
        for name, values in (("radiance", image.radiance), ("variance", image.variance)):
            self.files.array(name)[*image_index, window.rows, window.columns] = values
        valid = self.files.array("valid")
        whole = np.full(valid.shape[2:], MaskBit.OUTSIDE, dtype=np.uint16)
        whole[window.rows, window.columns] = bits
        valid[image_index] = whole
        if image.displacement is None:
            return
        motion = self.files.array("motion")
        step = stored_step((valid.shape[2], valid.shape[3]))
        top, left = -(-window.top // step), -(-window.left // step)
        rows, columns = image.displacement.shape[:2]
        motion[*image_index, top : top + rows, left : left + columns] = image.displacement
