"""The peer of a tooth's fit: stock ``prbvolpath`` and ``mitsuba.ad.Adam`` on the same meshes and photographs.

It follows Mitsuba's tutorials: a loss over linear images under each light, a backward pass through each render, one
step of Adam per round of all lights. Extinction and albedo of both media are free, in the same unbounded domain as in
our fit, with equal learning rates for all; g is held fixed.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from services.bench.fits.tooth_capture import CHANNEL, PreparedTooth
from services.core.files.meshes import write_mesh
from services.fit.coordinates.domain import LN10, to_dual, to_natural
from services.transport.optics.parameters import Medium, Tissue

START = Medium(6.0, 0.99, g1=0.8)
"""Medium of enamel and dentin at the start."""
SAMPLES = 16
"""Paths per pixel of an image and of its derivative."""
NAMES = ("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")
LEAVES = {"sigma": "sigma_t.value.value", "alpha": "albedo.value.value"}


class StockFit:
    """One fit at one learning rate, which can be continued step by step."""

    def __init__(
        self, case: PreparedTooth, folder: Path, rate: float, samples: int = SAMPLES, start: Medium = START
    ) -> None:
        """Load one scene per fitted light; this counts as time of the fit."""
        import drjit as dr
        import mitsuba as mi

        from services.assets.mitsuba.scene import load_scene, nested_scene

        self.rate, self.rounds, self.seconds, self._samples = rate, 0, 0.0, samples
        begun = time.process_time()
        files = folder / "outer.ply", folder / "dentin.ply"
        observations, (tooth,), (view,) = case.observations, case.observations.teeth, case.views
        assert tooth.dentin is not None
        for file, mesh in zip(files, (tooth.outer, tooth.dentin), strict=True):
            write_mesh(file, mesh)
        self._start, (width, height) = Tissue(start, start), view.camera.size
        x, y = view.pixels.T
        positions, intensities = observations.light_positions_mm, observations.light_intensities(CHANNEL)
        self._scenes: list[tuple[Any, Any, Any, Any]] = []
        signal = 0.0
        for light in np.flatnonzero(~view.held_out):
            where, intensity = positions[light], float(intensities[light])
            scene = load_scene(
                nested_scene({"tooth": files}, self._start, (view.camera,), where, intensity, samples=samples)
            )
            reference, counts = np.zeros((2, height, width, 1), dtype=np.float32)
            counts[y, x, 0] = view.valid[light]
            reference[y, x, 0] = np.where(view.valid[light], view.reference[light], 0.0)
            signal += float((reference.astype(np.float64) ** 2).sum())
            self._scenes.append((scene, mi.traverse(scene), mi.TensorXf(reference), mi.TensorXf(counts)))
        self._signal = signal
        self._optimizer = mi.ad.Adam(lr=rate)
        for name in NAMES:
            self._optimizer[name] = mi.Float(to_dual(name.split(".")[1], self._start.value(name)))
        dr.eval(*(self._optimizer[name] for name in NAMES))
        self.seconds += time.process_time() - begun

    def step(self) -> None:
        """Render all fitted lights once, then take a step of Adam."""
        import drjit as dr
        import mitsuba as mi

        begun = time.process_time()
        for k, (scene, params, reference, counts) in enumerate(self._scenes):
            for name in NAMES:
                part, leaf = name.split(".")
                x = self._optimizer[name]
                params[f"medium_{part}.{LEAVES[leaf]}"] = dr.exp(x) if leaf == "sigma" else 1 - dr.exp(-LN10 * x)
            params.update()
            seed = 2 * (self.rounds * len(self._scenes) + k)
            image = mi.render(scene, params, spp=self._samples, spp_grad=self._samples, seed=seed, seed_grad=seed + 1)
            dr.backward(dr.sum(dr.square((image - reference) * counts)) / self._signal)
        self._optimizer.step()
        dr.eval(*(self._optimizer[name] for name in NAMES))
        dr.sync_thread()
        self.rounds += 1
        self.seconds += time.process_time() - begun

    def tissue(self) -> Tissue:
        """Return the present estimate of the media."""
        values = {name: to_natural(name.split(".")[1], float(self._optimizer[name][0])) for name in NAMES}
        return self._start.with_values(values)
