"""Render the micro-CT incisor of the reference data with a rough surface by stock Mitsuba: 3 cameras, 8 lights, pixels
of 0.5 mm, one channel. Stock Mitsuba loses light that meets several facets, and so must a fit of these images.

python -m tests.benchmarks.render_rough_incisor --sweeps 16

Each sweep adds one batch of paths to every image, and the sums are kept in ``.cache``: a run goes on where the last one
ended. ``tests.benchmarks.rough_incisor`` fits them.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.mitsuba.scene import load_scene, nested_scene
from services.core.geometry import Camera, Light, teeth_folder
from services.core.records import FolderCapture
from services.core.store import read_record
from services.phantom.surface import INK
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device

CHECKOUT = Path(__file__).resolve().parents[2]
SOURCE = CHECKOUT.parent / "shared" / "data" / "tooth-ur1-truth"
"""The scanned incisor with its rig; not part of the project."""
SUMS = CHECKOUT / ".cache" / "rough-incisor.npz"
HIGHLIGHTS = CHECKOUT / ".cache" / "rough-incisor-highlights.npy"
FDI = 11
TISSUE = Tissue(Medium(6.0, 0.9965, g1=0.80), Medium(11.0, 0.993, g1=0.70))
"""Enamel and dentin within the literature's spread; each scatters by one lobe, as in a fit."""
IOR, ROUGHNESS = 1.63, 0.15
BATCH_SAMPLES, INK_SAMPLES = 128, 16
"""Paths per pixel of a batch, and of the image of black ink below the same surface, which shows the highlights alone:
its noise is a hundredth of the other's."""
HIGHLIGHT_SAMPLES = 256
"""Paths per pixel of the highlights that photographs show."""


@dataclass
class Sums:
    """Sums over batches of the light that has come out of the tooth."""

    total: NDArray[np.float64]
    """Sum of the batches' radiance (C, L, H, W)."""
    squares: NDArray[np.float64]
    """Sum of its square (C, L, H, W)."""
    batches: NDArray[np.int64]
    """Number of batches (C, L)."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """Radiance (C, L, H, W)."""
        return self.total / self.batches[:, :, None, None]

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance (C, L, H, W) of the mean."""
        count = self.batches[:, :, None, None]
        return np.maximum(self.squares / count - self.mean**2, 0) / (count - 1)

    def store(self, path: Path) -> None:
        """Replace the stored sums."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        np.savez_compressed(partial, total=self.total, squares=self.squares, batches=self.batches)
        partial.replace(path)

    @staticmethod
    def read(path: Path, shape: tuple[int, int, int, int]) -> Sums:
        """The stored sums, or empty ones."""
        if not path.exists():
            return Sums(np.zeros(shape), np.zeros(shape), np.zeros(shape[:2], dtype=np.int64))
        with np.load(path) as stored:
            return Sums(stored["total"], stored["squares"], stored["batches"])


def rig() -> FolderCapture:
    """The cameras and lights of the reference data."""
    if not SOURCE.is_dir():
        raise SystemExit("The reference data tooth-ur1-truth is not beside the checkout; this benchmark needs it.")
    return read_record(SOURCE / "capture.json", FolderCapture)


def sums(path: Path = SUMS) -> Sums:
    """What is rendered so far."""
    capture = rig()
    width, height = capture.cameras[0].size
    return Sums.read(path, (len(capture.cameras), len(capture.lights), height, width))


@dataclass(frozen=True)
class LitScene:
    """A scene whose point light is put in the place of each of the rig's in turn."""

    scene: Any
    params: Any

    @staticmethod
    def of(camera: Camera, media: Tissue) -> LitScene:
        """The incisor of some media before a camera."""
        import mitsuba as mi

        folder = teeth_folder(SOURCE, FDI)
        files = {str(FDI): (folder / "outer.ply", folder / "dentin.ply")}
        scene = load_scene(
            nested_scene(files, media, (camera,), (0, 0, 0), 1.0, boundary="rough", ior=IOR, roughness=ROUGHNESS)
        )
        return LitScene(scene, mi.traverse(scene))

    def image(self, light: Light, samples: int, seed: int) -> NDArray[np.float64]:
        """Radiance (H, W) under a light."""
        import mitsuba as mi

        self.params["light.position"] = mi.Point3f(*light.position_mm)
        self.params["light.intensity.value"] = mi.Float(light.intensity[0])
        self.params.update()
        return np.array(mi.render(self.scene, spp=samples, seed=seed), dtype=np.float64)[..., 0]


def add_sweep(found: Sums, path: Path) -> None:
    """Add one batch to each image that has the fewest, and store the sums after each image."""
    capture, sweep = rig(), int(found.batches.min())
    for c, camera in enumerate(capture.cameras):
        whole, ink = (LitScene.of(camera, media) for media in (TISSUE, INK))
        for n, light in enumerate(capture.lights):
            if found.batches[c, n] > sweep:
                continue
            seed = 2 * ((sweep * len(capture.cameras) + c) * len(capture.lights) + n)
            inside = whole.image(light, BATCH_SAMPLES, seed) - ink.image(light, INK_SAMPLES, seed + 1)
            found.total[c, n] += inside
            found.squares[c, n] += inside**2
            found.batches[c, n] += 1
            found.store(path)


def highlights(path: Path = HIGHLIGHTS) -> NDArray[np.float64]:
    """Radiance (C, L, H, W) that the surface reflects; rendered where it is not stored, in half a minute."""
    if not path.exists():
        capture, images = rig(), []
        for c, camera in enumerate(capture.cameras):
            ink = LitScene.of(camera, INK)
            images.append([ink.image(one, HIGHLIGHT_SAMPLES, 977 + 8 * c + n) for n, one in enumerate(capture.lights)])
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.array(images))
    return np.asarray(np.load(path))


def main() -> None:
    """Render so many sweeps in all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", type=int, default=16, help=f"batches of {BATCH_SAMPLES} paths per pixel in all")
    parser.add_argument("--sums", type=Path, default=SUMS)
    given = parser.parse_args()
    prepare_device(threads=1)
    found = sums(given.sums)
    while found.batches.min() < given.sweeps:
        add_sweep(found, given.sums)
        noise = ""
        if found.batches.min() > 1:
            norms = [np.sqrt(one.sum(axis=(2, 3))) for one in (found.variance, found.mean**2)]
            noise = f"noise of an image {np.median(norms[0] / norms[1]):.1%} of its norm, "
        print(f"{found.batches.min()} sweeps, {noise}{time.process_time():.0f} s", flush=True)


if __name__ == "__main__":
    main()
