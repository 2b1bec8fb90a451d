"""An engine without light transport: a smooth formula with seeded noise, for tests of everything around the engine.

The image of a pixel with enamel of thickness d under a light at angle c has a near part from enamel and a deep part
from dentin::

    I = c (1 - T) a_e^1.5 + T c^(1/2) a_d^1.5 (1 - exp(-s_d c^2)) + 0.05,   T = exp(-s_e d)

with reduced scattering s and reduced albedo a, so the images determine the reduced quantities and nothing else. A stain
multiplies the image by its transmittance at the texel that a pixel shows (light that leaves), and by its mean over all
texels of the tooth (light that enters). Noise is Gaussian and relative, falls with the samples and depends on seed,
camera, light and pixel alone.
"""

# ruff: noqa: ARG002 - signatures are those of the real engine
from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.anatomy.blend import MODES
from services.core.errors import NonFiniteError
from services.fit.solve.table_search import bin_powers
from services.transport.optics.parameters import Stain, Tissue
from services.transport.scene.recipe import JacobianEstimate, SceneRecipe, StackEstimate, StainGradient, View
from services.transport.scene.stain_uv import bilinear_texels

Array = NDArray[np.float64]

NOISE = 1.0
"""Standard deviation of the estimate from one path, relative to the pixel's value."""
SCORE_NOISE = 1.0


@dataclass(frozen=True)
class Geometry:
    """What the formula takes from a view alone: N pixels under L lights."""

    x: Array
    """Horizontal coordinate (N,) of the pixels."""
    thickness: Array
    """Thickness d (N,) of the enamel."""
    cosine: Array
    """Cosine c (L, N) of the light's angle."""
    root_cosine: Array
    square_cosine: Array
    own: NDArray[np.uint64]
    """Counters (L, N) of the noise that each light has alone."""
    shared: NDArray[np.uint64]
    """Counters (L, N) of the noise that all lights share."""


class FakeEngine:
    """Stand-in with the methods of the real engine."""

    directness = 0.0
    """Factor of enamel's mean cosine in its apparent scattering. Above zero, media of equal reduced quantities give
    different images."""
    path_noise = NOISE
    shared_noise = 0.0
    """Share of the noise's variance that is common to all lights of a pixel, as when one random walk serves them
    all."""

    def __init__(self, recipe: SceneRecipe, threads: int | None = None) -> None:
        self.recipe = recipe
        self._geometries: dict[bytes, Geometry] = {}

    def images(self, tissue: Tissue, view: View, *, samples: int, seed: int, batches: int = 16) -> StackEstimate:
        truth = self._formula(tissue, view)
        sigma = self.path_noise / np.sqrt(samples) * truth
        return StackEstimate(truth + sigma * self._normal(view, seed, 0), sigma**2)

    def jacobian(
        self, tissue: Tissue, view: View, names: tuple[str, ...], *, samples: int, seed: int, batches: int = 4
    ) -> JacobianEstimate:
        image = self.images(tissue, view, samples=samples, seed=seed)
        rows = []
        for k, name in enumerate(names):
            step = 1e-5 * max(abs(tissue.value(name)), 1e-3)
            high, low = (self._formula(tissue.with_values({name: tissue.value(name) + s}), view) for s in (step, -step))
            exact = (high - low) / (2 * step)
            scale = SCORE_NOISE * self.path_noise * np.abs(exact).mean() / np.sqrt(samples)
            rows.append((exact + scale * self._normal(view, seed, k + 1), np.full(exact.shape, scale**2)))
        return JacobianEstimate(
            names, image.mean, image.variance, np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows])
        )

    def stain_gradient(
        self, tissue: Tissue, view: View, cotangent: Array, *, samples: int, seed: int, batches: int = 16
    ) -> StainGradient:
        image = self.images(tissue, view, samples=samples, seed=seed).mean
        assert tissue.stain is not None
        light = (np.asarray(cotangent) * image).sum(axis=0)
        texels, shares = self._texels(view, tissue.stain)
        values = tissue.stain.transmittance.reshape(-1)
        out = np.bincount(
            texels.reshape(-1),
            (shares * (light / (shares * values[texels]).sum(axis=1))[:, None]).reshape(-1),
            values.size,
        )
        entry = light.sum() / values.sum()
        gradient = (out + entry).reshape(tissue.stain.transmittance.shape)
        return StainGradient((gradient,), (np.zeros_like(gradient),), samples)

    def _texels(self, view: View, stain: Stain) -> tuple[NDArray[np.int64], Array]:
        # Each pixel shows the centre of a face chosen by its coordinates. Neighbouring pixels show faces far apart, so
        # smoothness cannot replace the data.
        uv = self.recipe.teeth[0].stain_uv
        assert uv is not None
        x, y = view.pixels.T
        middle = uv[(37 * x + 101 * y) % len(uv)].mean(axis=1)
        return bilinear_texels(middle, (stain.transmittance.shape[0], stain.transmittance.shape[1]))

    def order_images(
        self, tissue: Tissue, view: View, *, bin_edges: NDArray[np.int64], samples: int, seed: int, batches: int = 1
    ) -> Array:
        image = self.images(tissue, view, samples=samples, seed=seed).mean
        # Find the shares of the scattering orders whose power series in the albedo follows the formula's mean image.
        alphas = 1 - np.logspace(-4, -0.7, 40)
        white = self._formula(_with_albedo(tissue, 1.0), view)
        image = image * white / self._formula(tissue, view)
        grey = [self._formula(_with_albedo(tissue, a), view).mean() / white.mean() for a in alphas]
        powers = bin_powers(alphas, bin_edges)
        share = np.linalg.solve(powers.T @ powers + 1e-6 * np.eye(len(bin_edges) - 1), powers.T @ np.array(grey))
        return share[:, None, None] / share.sum() * image

    def _formula(self, tissue: Tissue, view: View) -> Array:
        geometry = self._geometry(view)
        thickness, cosine = geometry.thickness, geometry.cosine
        # Displacements of the dentin, which follow the weights of the blend shape, change nothing here.
        for m, c in enumerate(tissue.shape[: len(MODES)]):
            thickness = thickness * (1 + 0.3 * c * np.cos((m + 1) * geometry.x / 9.0))
        enamel, dentin = tissue.enamel, tissue.dentin
        through = np.exp(-enamel.sigma_s_reduced * (1 + self.directness * enamel.mean_cosine) * thickness)
        near = cosine * (1 - through) * enamel.alpha_reduced**1.5
        deep = (
            geometry.root_cosine
            * through
            * dentin.alpha_reduced**1.5
            * (1 - np.exp(-dentin.sigma_s_reduced * geometry.square_cosine))
        )
        image = np.asarray(near + deep + 0.05)
        if tissue.stain is not None:
            texels, shares = self._texels(view, tissue.stain)
            values = tissue.stain.transmittance.reshape(-1)
            image = image * (shares * values[texels]).sum(axis=1) * values.mean()
        if not np.isfinite(image).all():
            raise NonFiniteError("The formula is not finite; check the parameters.")
        return image

    def _geometry(self, view: View) -> Geometry:
        # The part of the formula that does not depend on the tissue, once for each view.
        key = view.pixels.tobytes() + np.asarray(view.camera.camera_from_world).tobytes()
        if key not in self._geometries:
            x, y = self._places(view)
            thickness = 0.3 + 0.9 * y / 34.0
            if self.recipe.teeth[0].dentin is None:
                thickness = thickness + 50.0
            direction = np.abs(self.recipe.light_positions_mm[:, :1]).astype(float) / 1000
            cosine = 0.35 + 0.6 * np.abs(np.cos(0.12 * x + direction * 3.0 + 0.1 * y))
            lights = np.arange(len(direction), dtype=np.uint64)[:, None]
            pixel = (view.pixels[:, 0] + 4096 * view.pixels[:, 1]).astype(np.uint64)[None]
            own, shared = (pixel + np.uint64(2**40) * place for place in (lights, np.full_like(lights, 1000)))
            self._geometries[key] = Geometry(x, thickness, cosine, np.sqrt(cosine), cosine**2, own, shared)
        return self._geometries[key]

    def _places(self, view: View) -> tuple[Array, Array]:
        # Coordinates of the pixels. Where the camera stands beside its place, which lies on a grid of 10 mm along the
        # world's axes, they are those that the same points of a ball around the tooth have from that place.
        pose, x, y = np.asarray(view.camera.camera_from_world), *view.pixels.T.astype(float)
        place = np.column_stack([pose[:, :3].round(), 10 * (pose[:, 3] / 10).round()])
        place[3] = 0.0, 0.0, 0.0, 1.0
        if np.array_equal(place, pose) or np.abs(place - pose)[:3, :3].max() > 0.1:
            return x, y
        vertices = self.recipe.teeth[0].outer.vertices_mm
        centre = vertices.mean(axis=0)
        origin, ways = view.camera.rays(x + 0.5, y + 0.5)
        along = ways @ (centre - origin)
        inside = np.linalg.norm(vertices - centre, axis=1).max() ** 2 - ((centre - origin) ** 2).sum() + along**2
        points = origin + (along - np.sqrt(np.maximum(inside, 0.0)))[:, None] * ways
        unmoved = view.camera.model_copy(update={"camera_from_world": tuple(map(tuple, place.tolist()))})
        seen_x, seen_y = unmoved.project(points)[0].T - 0.5
        return seen_x, seen_y

    def _normal(self, view: View, seed: int, stream: int) -> Array:
        # Counter-based random numbers per (seed, stream, light, pixel), so that blocks and order do not matter.
        geometry, key = self._geometry(view), (seed * 131 + stream * 7919 + sum(view.camera.name.encode())) % 2**63
        own = _normal(geometry.own, key)
        if not self.shared_noise:
            return own
        return np.sqrt(1 - self.shared_noise) * own + np.sqrt(self.shared_noise) * _normal(geometry.shared, key)


def _normal(places: NDArray[np.uint64], key: int) -> Array:
    first, second = _mix(np.array([key, key + 1], dtype=np.uint64))
    u = _uniform(places ^ first)
    v = _uniform(_mix(places + np.uint64(0x9E3779B9)) ^ second)
    return np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * v)


def _with_albedo(tissue: Tissue, alpha: float) -> Tissue:
    # The same tissue without stains, and with one albedo in enamel and dentin.
    return Tissue(replace(tissue.enamel, alpha=alpha), replace(tissue.dentin, alpha=alpha), tissue.shape)


def _mix(z: NDArray[np.uint64]) -> NDArray[np.uint64]:
    # splitmix64 (Steele, Lea and Flood 2014)
    with np.errstate(over="ignore"):
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def _uniform(z: NDArray[np.uint64]) -> Array:
    return (_mix(z) >> np.uint64(11)).astype(np.float64) / 2.0**53 + 2.0**-54


class DirectFakeEngine(FakeEngine):
    """A fake engine in which media of equal reduced quantities differ, and the lights of a pixel share noise."""

    directness = 0.5
    shared_noise = 0.3


class QuietFakeEngine(FakeEngine):
    """A fake engine with a hundredth of the variance, so that the errors of photographs and calibration dominate."""

    path_noise = 0.1 * NOISE


class Slowly(FakeEngine):
    """Mixin that makes each pass long enough for two workers to overlap and for a kill to land in mid-fit. The numbers
    are those of the engine that it is mixed with.
    """

    def images(self, tissue: Tissue, view: View, *, samples: int, seed: int, batches: int = 16) -> StackEstimate:
        time.sleep(0.01)
        return super().images(tissue, view, samples=samples, seed=seed)

    def jacobian(
        self, tissue: Tissue, view: View, names: tuple[str, ...], *, samples: int, seed: int, batches: int = 4
    ) -> JacobianEstimate:
        time.sleep(0.02)
        return super().jacobian(tissue, view, names, samples=samples, seed=seed)


class SlowFakeEngine(Slowly):
    """The fake engine with longer passes."""
