"""Derivative with respect to the texels of a stain, compared with central differences by the engine itself.

The derivative is that of the images projected on one picture, the residual of an L2 loss for a clean tooth. This
engine's method is one pass for all texels; the peer is two image passes per texel with common random numbers. Nearly
every path crosses two faces, so images are quadratic in a texel and differences have no bias: the peer uses the widest
step that the texture's bounds allow. It is measured on some of the texels that the camera sees; the time of this
engine's pass is divided equally among all texels that the camera sees.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.transport.gradient_rows import GradientRow
from services.bench.transport.incisor_stack import TISSUE, IncisorStack, incisor_stack
from services.transport.engine import Engine
from services.transport.optics.parameters import Stain
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces

Array = NDArray[np.float64]

MIDDLE, STEP = 0.6, 0.4
MIN_SIGNAL_SHARE = 0.05
"""Smallest derivative of a visible texel, as a fraction of the largest."""
PEER = "central differences, step 0.4"


def stain_rows(*, quick: bool) -> list[GradientRow]:
    """Return for each texel this engine's row, the peer's row and its summary; then the summary over all texels."""
    stack = incisor_stack(18 if quick else 54)
    size, samples, repeats, count = ((8, 8), 32, 3, 2) if quick else ((24, 20), 64, 4, 6)
    engine = Engine(_with_coordinates(stack))
    stained = replace(TISSUE, stain=Stain(np.full(size, MIDDLE)))
    view = stack.tooth_view(engine, stained)
    clean = engine.images(replace(TISSUE, stain=Stain(np.ones(size))), view, samples=2 * samples, seed=7).mean
    residual = engine.images(stained, view, samples=2 * samples, seed=8).mean - clean

    def ours(seed: int) -> Array:
        (texels,) = engine.stain_gradient(stained, view, residual, samples=samples, seed=seed).gradient
        assert texels is not None
        return texels

    ours(0)
    begun = time.process_time()
    estimates = np.stack([ours(100 + repeat) for repeat in range(repeats)])
    seconds = (time.process_time() - begun) / repeats
    mean = estimates.mean(axis=0)
    bright_pixels = np.argwhere(np.abs(mean) >= MIN_SIGNAL_SHARE * np.abs(mean).max())
    share = seconds / len(bright_pixels)

    rows, ratios = [], []
    for row, column in bright_pixels[np.linspace(0, len(bright_pixels) - 1, count).astype(int)]:
        name = f"texel {row}, {column}"
        values = estimates[:, row, column]

        def shifted(shift: float, seed: int, row: int = row, column: int = column) -> float:
            texels = np.full(size, MIDDLE)
            texels[row, column] += shift
            image = engine.images(replace(TISSUE, stain=Stain(texels)), view, samples=samples, seed=seed).mean
            return float((image * residual).sum())

        begun = time.process_time()
        differences = np.array(
            [(shifted(STEP, 200 + repeat) - shifted(-STEP, 200 + repeat)) / (2 * STEP) for repeat in range(repeats)]
        )
        theirs = (time.process_time() - begun) / repeats
        gap = values.mean() - differences.mean()
        z = float(-gap / np.sqrt((values.var(ddof=1) + differences.var(ddof=1)) / repeats))
        ratio = float(theirs * differences.var(ddof=1) / (share * values.var(ddof=1)))
        ratios.append(ratio)
        size_of = abs(float(values.mean()))
        common: dict[str, Any] = {"benchmark": "transport-gradient stains", "parameter": name, "samples": samples}
        rows.append(
            GradientRow(
                **common,
                peer="dentine",
                seconds=share,
                error=float(values.std(ddof=1)) / size_of,
                gradient=float(values.mean()),
            )
        )
        peer = GradientRow(
            **common,
            peer=PEER,
            seconds=theirs,
            error=float(differences.std(ddof=1)) / size_of,
            gradient=float(differences.mean()),
        )
        summary = {"benchmark": "transport-gradient stains-summary", "efficiency_ratio": ratio, "z": z}
        rows += [peer, peer.model_copy(update=summary)]
    means = {"parameter": None, "gradient": None, "z": None, "efficiency_ratio": float(np.exp(np.mean(np.log(ratios))))}
    return [*rows, rows[-1].model_copy(update=means)]


def _with_coordinates(stack: IncisorStack) -> SceneRecipe:
    """Return the tooth's scene with texture coordinates that run across and up as seen from the front."""
    scene = stack.recipe()
    vertices = stack.outer.vertices_mm[:, [0, 2]]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    coordinates = ((vertices - low) / (high - low))[stack.outer.faces]
    return replace(scene, teeth=(ToothSurfaces(stack.outer, scene.teeth[0].dentin, coordinates),))
