"""Speed of preparing one synthetic image, step by step, beside the bare library calls that do each step's arithmetic.

Both sides run alternately in one process on one thread, and the fastest of ``TURNS`` runs counts, in seconds of
processor time, which other work on the machine changes little. A step's bare calls do its arithmetic and nothing else:
no checks, no masks, and results written into preallocated buffers.
"""

from __future__ import annotations

import hashlib
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from services.bench.preparation.scene import Scene, make_scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZES = {True: (1280, 960), False: (5120, 3840)}
"""Width and height by ``quick``."""
TURNS = 3
LIGHT = 1
Work = Callable[[], object]


def run(quick: bool = False) -> list[dict[str, Any]]:
    """Return a row for each step, with its megapixels, its seconds and megapixels per second, the same of its bare
    calls, and the ratio of their times; then a row of the sums and one of the peak memory.
    """
    import cv2
    import numcodecs.blosc

    cv2.setNumThreads(1)
    numcodecs.blosc.set_nthreads(1)
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder), SIZES[quick], lights=2)
        steps, peak_gib = _steps(scene)
        rows = [_row(name, SIZES[quick], ours, bare) for name, (ours, bare) in steps.items()]
    counted = [row for row in rows if row["step"] not in {"flow", "footprint"}]
    seconds, bare_s = (sum(row[key] for row in counted) for key in ("seconds", "bare_s"))
    rows.append({"step": "all but flow and footprint", "seconds": seconds, "bare_s": bare_s, "ratio": seconds / bare_s})
    return [*rows, {"step": "memory", "peak_gib": peak_gib}]


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw the seconds of each step and of its bare calls."""
    from services.bench.plots import grid

    drawn = [row for row in rows if "seconds" in row][::-1]
    figure, (axes,) = grid(1)
    names = [row["step"] for row in drawn]
    axes.plot([row["seconds"] for row in drawn], names, "o", label="dentine")
    axes.plot([row.get("bare_s", np.nan) for row in drawn], names, "|", markersize=12, label="bare calls")
    axes.set(xlabel="processor time of an image, s", xlim=(0, None))
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8)
    return figure


def _row(name: str, size: tuple[int, int], ours: Work, bare: Work | None) -> dict[str, Any]:
    """Time a step and its bare calls alternately, and return their row."""
    megapixels, times = size[0] * size[1] / 1e6, [[np.inf], [np.inf]]
    for _ in range(TURNS):
        for work, own in zip((ours, bare), times, strict=True):
            if work is not None:
                began_s = time.process_time()
                work()
                own.append(time.process_time() - began_s)
    seconds, bare_s = (float(min(own)) for own in times)
    row: dict[str, Any] = {
        "step": name,
        "megapixels": megapixels,
        "seconds": seconds,
        "megapixels_per_s": megapixels / seconds,
    }
    if bare is not None:
        row |= {"bare_s": bare_s, "bare_megapixels_per_s": megapixels / bare_s, "ratio": seconds / bare_s}
    return row


def _steps(scene: Scene) -> tuple[dict[str, tuple[Work, Work | None]], float]:
    """Return each step with its bare calls, and the peak memory in GiB of preparing one image from counts to files."""
    from services.core.records import JobSpec
    from services.core.store import StageWriter
    from services.preprocess.masking.masks import HandMasks
    from services.preprocess.masking.valid import valid_bits
    from services.preprocess.opening import open_source
    from services.preprocess.tasks.attempt_files import STAGE, AttemptFiles
    from services.preprocess.tasks.blocks import ImageWriter
    from services.preprocess.tasks.plan import create_arrays
    from services.preprocess.views.subject import read_subject

    source = open_source(JobSpec(capture=scene.root), scene.root)
    subject = read_subject(source.root, whole=False)
    files = AttemptFiles(StageWriter(scene.root, STAGE, 1))
    files.begin("")
    create_arrays(files.folder / "prepared.zarr", source, with_shadows=False)
    camera, light = source.description.cameras[0], source.description.lights[LIGHT]
    files.put_view(subject.view_of(0, camera))
    view = files.view(0, camera)
    assert view is not None
    frames = source.matched_frames(0)
    motions = dict(source.match(view, frames, subject.footprint_in))
    writer = ImageWriter(files, source, subject, HandMasks(scene.root, source.description), view)
    images = source.images(view, (LIGHT,) * (TURNS + 1), motions)
    _, image = next(images)
    writer.store(LIGHT, image, 0.0)
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    bits = valid_bits(image, view.footprint, view.camera, light)
    pair = tuple(
        np.ascontiguousarray(frame) for frame in (scene.counts[..., 1], np.roll(scene.counts[..., 1], 1, axis=1))
    )
    window = scene.counts[view.window.rows, view.window.columns]
    return {
        "footprint": (lambda: subject.view_of(0, camera), None),
        "image": (lambda: next(images), BareImage(scene.root, window)),
        "mask": (
            lambda: valid_bits(image, view.footprint, view.camera, light, subject.glossy(view.footprint)),
            BareMask(image.radiance, image.variance, np.ascontiguousarray(view.footprint.normal)),
        ),
        "store": (
            lambda: _store(writer, image, bits),
            BareStore(scene.root, image.radiance, image.variance, bits),
        ),
        "flow": (lambda: dict(source.match(view, frames[1:2], subject.footprint_in)), BareFlow(*pair)),
    }, peak_gib


def _store(writer: Any, image: Any, bits: NDArray[np.uint16]) -> None:
    """Write an image as if for the first time, and compute the checksums of its files."""
    for name in ("radiance", "variance", "valid", "motion"):
        shutil.rmtree(writer.files.folder / "prepared.zarr" / name / "c", ignore_errors=True)
    writer.store_masked(LIGHT, image, bits)
    writer.files.files_of(0, LIGHT, writer.files.folder / "none")


class BareImage:
    """Bare calls of an image: decode a frame, subtract black, scale, square for the variance, and sample radiance and
    variance at the moved positions of the pixels.
    """

    def __init__(self, folder: Path, window: NDArray[np.uint16]) -> None:
        import numcodecs

        self._codec = numcodecs.Blosc(cname="zstd", clevel=1, shuffle=numcodecs.Blosc.BITSHUFFLE)
        self._path = folder / "bare-frame"
        self._path.write_bytes(self._codec.encode(np.ascontiguousarray(window)))
        self._counts = np.empty_like(window)
        self._black = np.full(window.shape, 64, dtype=np.float32)
        self._buffers = [np.empty(window.shape, dtype=np.float32) for _ in range(4)]
        y, x = np.mgrid[: window.shape[0], : window.shape[1]].astype(np.float32)
        self._places = x + np.float32(0.3), y + np.float32(0.4)

    def __call__(self) -> None:
        """Make the calls once, with results in preallocated buffers."""
        import cv2

        self._codec.decode(self._path.read_bytes(), self._counts)
        radiance, variance, radiance_at, variance_at = self._buffers
        flat = (-1, self._counts.shape[1] * 3)
        planes = [one.reshape(flat) for one in (self._counts, self._black, radiance, variance)]
        cv2.subtract(planes[0], planes[1], dst=planes[2], dtype=cv2.CV_32F)
        cv2.multiply(planes[2], planes[2], dst=planes[3], scale=1e-4)
        cv2.add(planes[3], (1.0, 0, 0, 0), dst=planes[3])
        cv2.remap(radiance, *self._places, cv2.INTER_LINEAR, dst=radiance_at)
        cv2.remap(variance, *self._places, cv2.INTER_LINEAR, dst=variance_at)


class BareMask:
    """Bare calls of a highlight mask: products with fixed vectors, quotients, roots, comparisons and region growing."""

    def __init__(
        self, radiance: NDArray[np.float32], variance: NDArray[np.float32], normal: NDArray[np.float32]
    ) -> None:
        self._images = radiance, variance, normal
        self._matrices = [
            np.random.default_rng(k).random((rows, 3)).astype(np.float32) for k, rows in ((0, 2), (1, 3), (2, 4))
        ]

    def __call__(self) -> None:
        """Compute the light and its part along the chroma, three variances and four products of the normal; then one
        quotient per pixel for each of six estimates.
        """
        import cv2

        colour, spread, cosines = (
            cv2.transform(one, matrix) for one, matrix in zip(self._images, self._matrices, strict=True)
        )
        total, weight = cv2.extractChannel(colour, 0), cv2.extractChannel(spread, 0)
        for plane in (*(cv2.extractChannel(cosines, k) for k in range(4)), cv2.extractChannel(colour, 1), weight):
            cv2.multiply(total, plane, dst=plane)
            cv2.divide(plane, weight, dst=plane)
            cv2.sqrt(plane, dst=plane)
        small = cv2.resize(total, (total.shape[1] // 8, total.shape[0] // 8), interpolation=cv2.INTER_AREA)
        cv2.resize(cv2.GaussianBlur(small, (0, 0), 6), total.shape[::-1], interpolation=cv2.INTER_LINEAR)
        mask = cv2.compare(total, 0.9 * float(total.max()), cv2.CMP_GT)
        cv2.connectedComponents(mask)
        cv2.dilate(mask, np.ones((3, 3), np.uint8))


class BareStore:
    """Bare calls of storing an image: compress its arrays, write them and compute their checksums."""

    def __init__(self, folder: Path, *arrays: NDArray[Any]) -> None:
        import numcodecs

        self._codec = numcodecs.Blosc(cname="lz4", clevel=1, shuffle=numcodecs.Blosc.BITSHUFFLE)
        self._path, self._arrays = folder / "bare-store", arrays

    def __call__(self) -> None:
        """Store one file after the other."""
        for array in self._arrays:
            packed = self._codec.encode(array)
            self._path.write_bytes(packed)
            hashlib.sha256(packed).digest()


class BareFlow:
    """Bare call of the flow: OpenCV's DIS flow at its medium setting between two frames in 8 bits at full size."""

    def __init__(self, first: NDArray[np.uint16], second: NDArray[np.uint16]) -> None:
        self._pair = [(frame // 16).astype(np.uint8) for frame in (first, second)]

    def __call__(self) -> None:
        """Compute the flow once."""
        import cv2

        cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*self._pair, None)
