"""Peers of a tooth's fit: stock ``prbvolpath`` and ``mitsuba.ad.Adam`` on the same meshes and photographs.

They follow Mitsuba's tutorials: a loss over linear images under each light, a backward pass through each render with a
seed of its own, one step of Adam per round of all lights. The parameters of both media are free, in the same unbounded
domain as in our fit, with equal learning rates for all. A recipe says which parameters, and with how many paths.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.bench.fits.tooth_capture import CHANNEL, PreparedTooth
from services.core.files.meshes import write_mesh
from services.fit.coordinates.domain import LN10, to_dual, to_natural
from services.transport.optics.parameters import Medium, Tissue

MEDIA = ("enamel", "dentin")
ONE_LOBE = {"sigma": "sigma_t.value.value", "alpha": "albedo.value.value", "g1": "phase_function.g"}
"""Mitsuba's names of a medium's parameters, with one lobe and with two."""
TWO_LOBES = {
    "sigma": "sigma_t.value.value",
    "alpha": "albedo.value.value",
    "beta": "phase_function.weight.value.value",
    "g1": "phase_function.phase_0.g",
    "g2": "phase_function.phase_1.g",
}


@dataclass(frozen=True)
class StockRecipe:
    """How a stock fit goes about its work."""

    name: str
    samples: int
    """Paths per pixel of an image and of its derivative."""
    start: Medium
    """Medium of enamel and dentin at the start; two lobes where its ``beta`` is below 1."""
    homogeneous_rounds: int = 0
    """First rounds in which enamel and dentin are one medium."""

    @property
    def leaves(self) -> dict[str, str]:
        """Mitsuba's names of the free parameters of a medium."""
        return ONE_LOBE if self.start.beta >= 1 else TWO_LOBES

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all free parameters."""
        return tuple(f"{part}.{leaf}" for part in MEDIA for leaf in self.leaves)


TUTORIAL = StockRecipe("mitsuba-prbvolpath-adam", 16, Medium(6.0, 0.99, g1=0.8))
"""Plain use of stock Mitsuba: extinction, albedo and mean cosine of one lobe of both media, from one start."""
TEETH_2018 = StockRecipe("teeth-2018-recipe", 64, Medium(6.0, 0.99, 0.9, 0.8, 0.0), homogeneous_rounds=8)
"""What teeth 2018 says of its optimisation (section 6), with stock Mitsuba in place of its own integrator: Adam on all
parameters of two lobes of both media, 64 paths per pixel, L2 loss, image and derivative with seeds of their own, first
a homogeneous tooth, then both media. Two things differ: it searches its start in a table of 50,000 renders, and here it
begins where the other peer does, which takes no time; and it does not tell its learning rate, nor whether a step sees
all images, as it does here."""


class StockFit:
    """One fit at one learning rate, which can be continued step by step, and from a stored state."""

    def __init__(
        self,
        case: PreparedTooth,
        folder: Path,
        rate: float,
        recipe: StockRecipe = TUTORIAL,
        state: dict[str, Any] | None = None,
    ) -> None:
        """Load one scene per fitted light; this counts as time of the fit, unless it goes on from a stored state.

        Args:
            case: the photographs.
            folder: where to write the meshes.
            rate: learning rate of Adam in the unbounded domain.
            recipe: which parameters are fitted, and how.
            state: what ``state`` returned, of the same case, rate and recipe.
        """
        import drjit as dr
        import mitsuba as mi

        from services.assets.mitsuba.scene import load_scene, nested_scene

        self.rate, self.recipe, self.rounds, self.seconds = rate, recipe, 0, 0.0
        begun = time.process_time()
        files = folder / "outer.ply", folder / "dentin.ply"
        observations, (tooth,), (view,) = case.observations, case.observations.teeth, case.views
        assert tooth.dentin is not None
        for file, mesh in zip(files, (tooth.outer, tooth.dentin), strict=True):
            write_mesh(file, mesh)
        self._start, (width, height) = Tissue(recipe.start, recipe.start), view.camera.size
        x, y = view.pixels.T
        positions, intensities = observations.light_positions_mm, observations.light_intensities(CHANNEL)
        self._scenes: list[tuple[Any, Any, Any, Any]] = []
        signal = 0.0
        for light in np.flatnonzero(~view.held_out):
            where, intensity = positions[light], float(intensities[light])
            scene = load_scene(
                nested_scene({"tooth": files}, self._start, (view.camera,), where, intensity, samples=recipe.samples)
            )
            reference, counts = np.zeros((2, height, width, 1), dtype=np.float32)
            counts[y, x, 0] = view.valid[light]
            reference[y, x, 0] = np.where(view.valid[light], view.reference[light], 0.0)
            signal += float((reference.astype(np.float64) ** 2).sum())
            self._scenes.append((scene, mi.traverse(scene), mi.TensorXf(reference), mi.TensorXf(counts)))
        self._signal = signal
        self._optimizer = mi.ad.Adam(lr=rate)
        for name in recipe.names:
            self._optimizer[name] = mi.Float(to_dual(name.split(".")[1], self._start.value(name)))
        dr.eval(*(self._optimizer[name] for name in recipe.names))
        self.seconds += time.process_time() - begun
        if state is not None:
            self._restore(state)

    @property
    def state(self) -> dict[str, Any]:
        """All that a fit needs to go on, as JSON values: rounds, seconds, and by parameter its value and Adam's count,
        mean and mean square of the derivative.
        """
        moments = {}
        for name in self.recipe.names:
            value, _, _, (count, mean, square, _) = self._optimizer.state[name]
            moments[name] = [float(value.array[0]), *(float(np.array(one).item()) for one in (count, mean, square))]
        return {"rounds": self.rounds, "seconds": self.seconds, "moments": moments}

    def _restore(self, state: dict[str, Any]) -> None:
        import drjit as dr
        import mitsuba as mi

        self.rounds, self.seconds = int(state["rounds"]), float(state["seconds"])
        for name, (value, count, mean, square) in state["moments"].items():
            self._optimizer[name] = mi.Float(value)
            kept = self._optimizer.state[name]
            moments = (type(kept[3][0])(int(count)), mi.Float(mean), mi.Float(square), kept[3][3])
            self._optimizer.state[name] = (*kept[:3], moments)
        dr.eval(self._optimizer.state)

    @property
    def is_homogeneous(self) -> bool:
        """Whether enamel and dentin are one medium in the next round."""
        return self.rounds < self.recipe.homogeneous_rounds

    def step(self) -> None:
        """Render all fitted lights once, then take a step of Adam."""
        import drjit as dr
        import mitsuba as mi

        begun = time.process_time()
        for k, (scene, params, reference, counts) in enumerate(self._scenes):
            for name in self.recipe.names:
                part, leaf = name.split(".")
                x = self._optimizer[f"{MEDIA[0]}.{leaf}" if self.is_homogeneous else name]
                params[f"medium_{part}.{self.recipe.leaves[leaf]}"] = _natural(leaf, x)
            params.update()
            seed = 2 * (self.rounds * len(self._scenes) + k)
            samples = self.recipe.samples
            image = mi.render(scene, params, spp=samples, spp_grad=samples, seed=seed, seed_grad=seed + 1)
            dr.backward(dr.sum(dr.square((image - reference) * counts)) / self._signal)
        was_homogeneous = self.is_homogeneous
        self._optimizer.step()
        self.rounds += 1
        if was_homogeneous:
            for leaf in self.recipe.leaves:
                shared = self._optimizer[f"{MEDIA[0]}.{leaf}"]
                self._optimizer[f"{MEDIA[1]}.{leaf}"] = mi.Float(dr.detach(shared))
                # Forget the rounds in which dentin had no derivative, or its first steps would be too short.
                self._optimizer.reset(f"{MEDIA[1]}.{leaf}")
        dr.eval(*(self._optimizer[name] for name in self.recipe.names))
        dr.sync_thread()
        self.seconds += time.process_time() - begun

    def tissue(self) -> Tissue:
        """Return the present estimate of the media."""
        values = {name: to_natural(name.split(".")[1], float(self._optimizer[name][0])) for name in self.recipe.names}
        return self._start.with_values(values)


def _natural(leaf: str, x: Any) -> Any:
    # What Mitsuba calls a parameter's value, with its derivative; the weight of its blend is that of the second lobe.
    import drjit as dr

    if leaf == "sigma":
        return dr.exp(x)
    if leaf == "alpha":
        return 1 - dr.exp(-LN10 * x)
    return 1 / (1 + dr.exp(x)) if leaf == "beta" else dr.tanh(x)
