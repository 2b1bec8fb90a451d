"""Share of reflected light that the mask of highlights covers, compared to the best threshold on the true reflection.

python -m tests.benchmarks.highlights --json highlights.json
python -m tests.benchmarks.highlights --roughness 0.2 --json highlights.json

A glossy tooth at rest is rendered by stock Mitsuba (GGX, index 1.631) under twelve lights from two views, with 1 % of
noise; its reflected light is the difference to the same render without reflection. A row states the share of the
reflected light that is masked, and the share of dull pixels (reflection below 1 % of their diffuse light) that are
masked falsely. The best threshold knows the reflection of every pixel and masks the strongest until 3 % of the dull
pixels are masked; no mask of pixels can beat it. Where no pixel is dull it masks all; therefore a row also states the
share of reflected light in the strongest pixels, as many as the mask covers. The row "matte" is the tooth without its
reflection, where nothing should be masked. Rows that the file holds already are kept. A roughness takes some 5 seconds
of a core.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Camera, Light, Mesh
from services.core.records import MaskBit
from services.core.store import write_atomic
from services.preprocess.masking.valid import valid_bits
from services.preprocess.views.projection import project
from services.preprocess.views.source import LightImage

MATTE = "matte"
ROUGHNESS = (0.05, 0.1, 0.2, 0.3)
LIGHTS, VIEWS_DEG = 12, ((0, 0), (30, 10))
SIZE, PIXEL_MM, SAMPLES = (124, 156), 0.09, 16
NOISE_RELATIVE, NOISE_FLOOR = 0.01, 0.002
DULL = 0.01
"""Reflected light as a share of diffuse light below which a pixel is dull and should not be masked."""
FALSE = 0.03


def main() -> None:
    """Render, mask and judge each roughness."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--roughness", type=float, nargs="*", default=ROUGHNESS)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows: dict[str, Any] = json.loads(options.json.read_text()) if options.json.is_file() else {}
    for roughness in options.roughness:
        if str(roughness) not in rows:
            rows[str(roughness)] = row_of(renders(roughness), np.random.default_rng(options.seed))
            write_atomic(options.json, json.dumps(rows, indent=1).encode())
        print(roughness, rows[str(roughness)])
    if MATTE not in rows:
        rows[MATTE] = matte_row(renders(options.roughness[0]), np.random.default_rng(options.seed))
        write_atomic(options.json, json.dumps(rows, indent=1).encode())
    print(MATTE, rows[MATTE])


def renders(roughness: float) -> dict[str, NDArray[Any]]:
    """Render images with and without reflection; returns the arrays of ``render_moving_tooth.render``."""
    options = {
        "size": SIZE,
        "pixel_mm": PIXEL_MM,
        "views_deg": VIEWS_DEG,
        "lights": LIGHTS,
        "frames": [(light, 0.0) for light in range(LIGHTS)],
        "amplitude_mm": 0.0,
        "roughness": roughness,
        "spp": SAMPLES,
    }
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tooth.npz"
        command = [sys.executable, "-m", "tests.support.render_moving_tooth", str(out), json.dumps(options)]
        subprocess.run(command, check=True)
        with np.load(out) as stored:
            return dict(stored)


def row_of(rendered: dict[str, NDArray[Any]], random: np.random.Generator) -> dict[str, float]:
    """Shares of masked light and pixels over all lights and views."""
    reflected, share, masked = (np.concatenate(one) for one in zip(*_pixels(rendered, random), strict=True))
    energy, false = _shares(reflected, share, masked)
    # The best threshold masks pixels by the ratio of their reflected to their diffuse light, highest first.
    best_energy, best_false = _shares(*_best(reflected, share))
    return {
        "energy": energy,
        "false": false,
        "best_energy": best_energy,
        "best_false": best_false,
        "of_best": energy / best_energy,
        "best_of_as_many": _shares(reflected, share, _strongest(share, int(masked.sum())))[0],
        "dull": float((share < DULL).mean()),
        "masked": float(masked.mean()),
        "pixels": len(masked),
    }


def matte_row(rendered: dict[str, NDArray[Any]], random: np.random.Generator) -> dict[str, float]:
    """Share of the pixels that is masked where nothing reflects."""
    pixels = _pixels(rendered | {"total": rendered["diffuse"]}, random)
    masked = np.concatenate([own for _, _, own in pixels])
    return {"masked": float(masked.mean()), "pixels": len(masked)}


Column = NDArray[Any]


def _pixels(rendered: dict[str, NDArray[Any]], random: np.random.Generator) -> list[tuple[Column, Column, Column]]:
    """Reflected light, its ratio to diffuse light, and whether the pixel is masked (each (N,)), by camera and light.
    The pixels are those that show only the tooth and are lit.
    """
    height, width = rendered["total"].shape[2:4]
    mesh, found = Mesh(rendered["vertices_mm"], rendered["faces"]), []
    for k, pose in enumerate(rendered["camera_from_world"]):
        camera = Camera(name=f"c{k}", size=(width, height), K=rendered["K"].tolist(), camera_from_world=pose.tolist())
        footprint = project(camera, [mesh])
        for j, place in enumerate(rendered["lights_mm"]):
            light = Light(name=f"l{j}", position_mm=place.tolist(), intensity=rendered["intensity"].tolist())
            total, diffuse = (rendered[name][k, j].astype(np.float64) for name in ("total", "diffuse"))
            variance = (NOISE_RELATIVE * total) ** 2 + (NOISE_FLOOR * total.max()) ** 2
            radiance = total + np.sqrt(variance) * random.standard_normal(total.shape)
            image = LightImage(
                radiance.astype(np.float32), variance.astype(np.float32), np.zeros((height, width), dtype=np.uint16)
            )
            bits = valid_bits(image, footprint, camera, light)
            reflected = np.maximum(total - diffuse, 0).mean(axis=-1)
            share = reflected / np.maximum(diffuse.mean(axis=-1), 1e-9 * total.max())
            lit = footprint.covered & (total.mean(axis=-1) > 0)
            found.append((reflected[lit], share[lit], (bits[lit] & np.uint16(MaskBit.HIGHLIGHT)) > 0))
    return found


def _shares(reflected: Column, share: Column, masked: Column) -> tuple[float, float]:
    """Share of the reflected light that is masked, and share of the dull pixels that are masked."""
    dull = share < DULL
    return float(reflected[masked].sum() / reflected.sum()), float((masked & dull).sum() / max(dull.sum(), 1))


def _best(reflected: Column, share: Column) -> tuple[Column, Column, Column]:
    """Arguments of ``_shares`` for the threshold that masks a share ``FALSE`` of the dull pixels."""
    dull = np.sort(share[share < DULL])
    return reflected, share, share >= (dull[int((1 - FALSE) * len(dull))] if len(dull) else 0)


def _strongest(share: Column, count: int) -> Column:
    """Mask (N,) of the ``count`` pixels with the strongest reflection."""
    chosen = np.zeros(len(share), dtype=bool)
    chosen[np.argsort(share)[len(share) - count :]] = True
    return chosen


if __name__ == "__main__":
    main()
