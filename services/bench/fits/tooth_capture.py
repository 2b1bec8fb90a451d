"""Prepared captures of one tooth for benchmarks of its fit, and the measurement of a fit's error on them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.core.store import is_published
from services.fit.measurements.observations import Observations, channel_scene, read_channel, read_observations
from services.fit.measurements.surface import held_surface
from services.fit.measurements.view_stack import ViewStack
from services.fit.passes.evaluate import ErrorSums, error_sums
from services.fit.stages.attempt import CHECKPOINT
from services.transport.engine import Engine
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Tissue
from services.transport.scene.recipe import View

REAL_TOOTH = Path("shared") / "data" / "tooth-ur1-truth"
"""Capture of a scanned incisor; a phantom replaces it where this data does not lie beside the checkout."""
CAMERA, CHANNEL = "c0", "green"
NOISE_RELATIVE, NOISE_FLOOR = 0.01, 0.002
"""Standard deviations of the two parts of the sensor noise, as fractions of the pixel's value and of the image's
maximum."""
PHANTOM_SAMPLES = 256


def real_tooth() -> Path | None:
    """Return the folder of the scanned incisor's capture; None where this data does not lie beside the checkout."""
    folder = Path(__file__).resolve().parents[4] / REAL_TOOTH
    return folder if folder.is_dir() else None


def sensor_noise(image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the variance of the sensor noise, which is 0 beside the tooth."""
    return np.where(image > 0, (NOISE_RELATIVE * image) ** 2 + (NOISE_FLOOR * image.max()) ** 2, 0.0)


def photograph(
    mean: NDArray[np.float64], variance: NDArray[np.float64], random: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a rendered image with sensor noise added, and its variance including that of the noise, both as stored."""
    added = sensor_noise(mean)
    return (mean + np.sqrt(added) * random.standard_normal(mean.shape)).astype(np.float32), (variance + added).astype(
        np.float32
    )


def write_photograph(
    source: Path,
    target: Path,
    files: tuple[str, str],
    random: np.random.Generator,
    added: NDArray[np.float64] | float = 0.0,
) -> None:
    """Store a rendered image with sensor noise as a photograph, and its variance beside it.

    Args:
        source: folder of the rendered image.
        target: folder to write to.
        files: names of image and variance, equal in both folders.
        random: generator of the noise.
        added: radiance that is added to the image before the noise.
    """
    mean, variance = (np.load(source / file).astype(np.float64) for file in files)
    for file, values in zip(files, photograph(mean + added, variance, random), strict=True):
        np.save(target / file, values)


def write_noisy(source: Path, target: Path, seed: int, camera: str = CAMERA) -> None:
    """Copy one camera of a folder capture and add sensor noise."""
    shutil.copytree(source / "teeth", target / "teeth")
    description = json.loads((source / "capture.json").read_text())
    description["cameras"] = [one for one in description["cameras"] if one["name"] == camera]
    description["images"] = [image for image in description["images"] if image["camera"] == camera]
    (target / "capture.json").write_text(json.dumps(description))
    random = np.random.default_rng(seed)
    for image in description["images"]:
        write_photograph(source, target, (image["file"], image["variance_file"]), random)


@dataclass(frozen=True)
class PreparedTooth:
    """A prepared capture of a tooth or a jaw in one channel, and the engine that measures the error of a fit on it,
    with exact media and equally for all peers.
    """

    job: Path
    """Folder with the stage ``prepared``."""
    spec: JobSpec
    observations: Observations
    views: tuple[ViewStack, ...]
    engine: Engine
    truth: Tissue | None = None
    """The true media; None where they are not known."""

    def errors(self, tissue: Tissue | Mouth, *, samples: int, seed: int) -> tuple[ErrorSums, ErrorSums]:
        """Return the error sums on fitted and on held-out images, from two renders of so many paths per pixel."""
        fitted, held_out = ErrorSums(), ErrorSums()
        for number, view in enumerate(self.views):
            bare_view = View(view.camera, view.pixels)
            first, second = (
                self.engine.images(tissue, bare_view, samples=samples, seed=7919 * number + 2 * seed + k).mean
                for k in range(2)
            )
            held = view.held_out[:, None]
            fitted += error_sums(first, second, view.reference, view.variance, view.valid & ~held)
            held_out += error_sums(first, second, view.reference, view.variance, view.valid & held)
        return fitted, held_out

    def resolution(self, held_out: bool = True) -> float:
        """Return the error that the photographs' own noise may cause, as one standard deviation."""
        chosen = [view.valid & (view.held_out[:, None] == held_out) for view in self.views]
        reference, variance = (
            np.concatenate([getattr(view, name)[one] for view, one in zip(self.views, chosen, strict=True)])
            for name in ("reference", "variance")
        )
        return float((2 * variance @ variance) ** 0.25 / np.sqrt(reference @ reference - variance.sum()))


def prepare(job: Path, spec: JobSpec) -> None:
    """Run the preparation, the stage before the fit. Benchmarks begin with a capture, so they alone import two
    services.
    """
    from services.preprocess.stage import run

    run(spec, LocalContext(job))


def prepared_tooth(job: Path, spec: JobSpec, channel: str = CHANNEL) -> PreparedTooth:
    """Prepare a capture below ``job`` if it is not prepared, and build its scene."""
    from services.anatomy.job_dentin import dentin_shape
    from services.transport.platform import prepare_device

    prepare_device()
    if not is_published(job, "prepared"):
        prepare(job, spec)
    observations = read_observations(job, spec)
    (tooth,) = observations.teeth
    dentin = dentin_shape(tooth, observations.manifest.cameras, spec)
    surface = held_surface(spec, observations, job / CHECKPOINT, print)
    recipe = channel_scene(observations, channel, (dentin,), spec, surface=surface)
    return PreparedTooth(job, spec, observations, read_channel(observations, channel, spec), Engine(recipe))


def smallest_case(folder: Path, *, pixel_step: int = 1, seed: int = 1) -> PreparedTooth:
    """Write and prepare the smallest real case below ``folder``: one view, with five lights to fit and those that the
    capture holds out.
    """
    source = real_tooth()
    if source is None:
        from services.phantom.tooth import write_phantom

        source = folder / "phantom"
        write_phantom(source, cameras=1, samples=PHANTOM_SAMPLES, renderer="mitsuba", subject=1)
    write_noisy(source, folder / "capture", seed)
    options = {
        "capture": folder / "capture",
        "boundary": "matched",
        "dentin": "known",
        "pixel_step": pixel_step,
        "seed": seed,
    }
    truth = true_tissue(json.loads((source / "truth.json").read_text()))
    return replace(prepared_tooth(folder / "job", JobSpec.model_validate(options)), truth=truth)


def true_tissue(known: Mapping[str, Any]) -> Tissue:
    """Return the media that ``truth.json`` tells, of a phantom or of the scanned incisor, whose names are Mitsuba's."""
    media = known["channels"][CHANNEL] if "channels" in known else known

    def medium(values: Mapping[str, float]) -> Medium:
        if "sigma" in values:
            return Medium(values["sigma"], values["alpha"], values["beta"], values["g1"], values["g2"])
        g1 = values["g1"] if "g1" in values else values["g"]
        return Medium(values["sigma_t"], values["albedo"], values.get("beta", 1.0), g1, values.get("g2", 0.0))

    return Tissue(medium(media["enamel"]), medium(media["dentin"]))


def tissue_of(values: Mapping[str, float]) -> Tissue:
    """Return the media of the parameters that a fit reports; a tooth without dentin is enamel throughout."""

    def medium(part: str) -> Medium:
        sigma, alpha, beta, g1, g2 = (values[f"{part}.{leaf}"] for leaf in MEDIUM_FIELDS)
        return Medium(sigma, alpha, beta, g1, g2)

    enamel = medium("enamel")
    shape = tuple(values[name] for name in sorted(values) if name.startswith("shape."))
    return Tissue(enamel, medium("dentin") if "dentin.sigma" in values else enamel, shape)
