"""The prepare stage: a capture in, the published ``prepared`` store out."""

from __future__ import annotations

import importlib

from services.core.errors import SettingsError
from services.core.installed import require_packages
from services.core.placement import WEIGHTS
from services.core.provenance.record import INPUTS, Inputs
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.core.stage import CANCEL_FLAG, StageContext, StageEvent
from services.core.store import StageWriter, write_record

PACKAGES = ("cv2", "imagecodecs", "jinja2", "rtree", "tifffile")
"""Import names of the packages that the extra ``preprocess`` installs."""


def check() -> None:
    """Import every module and package that a preparation needs.

    Raises:
        PlatformError: a package is missing.
    """
    require_packages(PACKAGES, "preprocess")
    for module in ("opening", "tasks.blocks", "tasks.plan", "tasks.progress", "tasks.summary"):
        importlib.import_module(f"services.preprocess.{module}")


def run(spec: JobSpec, context: StageContext) -> PreparedManifest:
    """Prepare ``spec.capture``, or the job's own published capture, and publish ``prepared``.

    Images are made in blocks, on all workers that may run this stage. Blocks that an earlier attempt has finished are
    not made again.

    Raises:
        CaptureInputError: a file, frame, camera or light is missing or malformed. MeshError: a surface cannot bound a
            medium.
        SettingsError: an option names an unknown light or channel. StoreError: the capture store is damaged.
            JobCancelledError: the job was cancelled.
    """
    from services.core.provenance.inputs import hashed_inputs
    from services.preprocess.masking.masks import HandMasks
    from services.preprocess.masking.valid import require_plausible_scale
    from services.preprocess.opening import open_source
    from services.preprocess.tasks.attempt_files import KINDS, STAGE, AttemptFiles
    from services.preprocess.tasks.blocks import PreparationBlock, blocks_of, calls_of, images_of
    from services.preprocess.tasks.plan import create_arrays, digest_of_inputs, held_out_images
    from services.preprocess.tasks.progress import Progress
    from services.preprocess.tasks.summary import summarise
    from services.preprocess.views.subject import read_subject
    from services.tasks.executors import executor

    # Check everything that needs no pixel
    source = open_source(spec, context.root)
    cameras, channels = source.description.cameras, source.description.channels
    held_out = held_out_images(spec, source)
    if spec.channels == ():
        raise SettingsError("Option 'channels' is empty; name a channel, or leave it out to fit all.")
    if unknown := set(spec.channels or ()) - set(channels):
        raise SettingsError(
            f"Option 'channels' names {min(unknown)}, but the capture has {', '.join(channels)}; correct it."
        )
    masks = HandMasks(context.root, source.description)
    subject = read_subject(
        source.root, spec.kind == "jaw", spec.fdi, spec.surroundings, is_object=spec.kind == "object"
    )
    require_plausible_scale(cameras, source.description.lights, subject.teeth)
    if subject.note is not None:
        context.report(StageEvent(stage="prepare", kind="log", message=subject.note))

    files = AttemptFiles(StageWriter(context.root, STAGE, context.attempt))
    digest = digest_of_inputs(spec, source, masks)
    if not files.begin(digest, spec.store):
        create_arrays(files.arrays, source, with_shadows=spec.shadows)
        files.mark_resumable(digest)
    for note in files.records.set_damaged_aside(KINDS):
        context.report(StageEvent(stage="prepare", kind="log", message=note))

    lights = [source.lights_of(k) for k in range(len(cameras))]
    progress = Progress(context, sum(len(own) for own in lights), len(cameras))
    flag, prefix = context.root / CANCEL_FLAG, f"block-{context.attempt}"
    with executor(flag, prefix=prefix, weight=WEIGHTS[spec.priority]) as run_on:
        threads = run_on.threads()
        unlocated = [k for k, camera in enumerate(cameras) if files.view(k, camera) is None]
        for _ in run_on.as_completed(calls_of(PreparationBlock(spec, files, "locate", k) for k in unlocated)):
            context.raise_if_cancelled()
        frames = [
            [one for one in source.matched_frames(k) if one not in files.motions(k, source.matched_frames(k))]
            for k in range(len(cameras))
        ]
        for _ in run_on.as_completed(calls_of(blocks_of(spec, files, "match", frames, threads))):
            context.raise_if_cancelled()
        # Run comparing and developing together, as neither needs the other. Comparisons come first, because a camera's
        # whole comparison is one block
        uncompared = [k for k in range(len(cameras)) if source.measures_motion and files.flow(k) is None]
        compare = [PreparationBlock(spec, files, "compare", k) for k in uncompared]
        missing = [[j for j in own if files.image(k, j) is None] for k, own in enumerate(lights)]
        progress.begin(sum(len(own) for own in missing), threads)
        develop = blocks_of(spec, files, "develop", missing, threads)
        for block in run_on.as_completed(calls_of([*compare, *develop])):
            for done in images_of(block, files):
                progress.report_image(done)
            context.raise_if_cancelled()
        if spec.shadows:
            unshaded = [k for k, own in enumerate(lights) if not all(files.is_shaded(k, j) for j in own)]
            progress.begin_shading(len(unshaded))
            for _ in run_on.as_completed(calls_of(PreparationBlock(spec, files, "shade", k) for k in unshaded)):
                context.raise_if_cancelled()

    manifest, known = summarise(files, source, subject, held_out, masks.digest, context)
    inputs = Inputs(
        files=hashed_inputs(spec, context.root, context.raise_if_cancelled),
        consent=source.description.consent,
        subject=source.description.subject,
    )
    write_record(files.folder / INPUTS, inputs)
    files.writer.publish(manifest, known)
    files.end()
    progress.finish()
    return manifest


def run_object(spec: JobSpec, context: StageContext) -> PreparedManifest:
    """As ``run``, of an object that is no tooth; what is wrong with its capture is said of an object.

    Raises:
        As ``run``.
    """
    from services.core.errors import CaptureInputError, MeshError
    from services.core.pages.object_words import of_an_object

    try:
        return run(spec, context)
    except (CaptureInputError, MeshError) as problem:
        raise type(problem)(of_an_object(problem.message)) from problem
