"""Test cases of the registration check: virtual teeth photographed in the place of their mesh or beside it, and the
renders that a fit would compare.

Every phantom is an incisor with its own size, pose, camera, five lights and optics; every second one stands in gums
that its render lacks. A phantom has renders of its mesh's place, and photographs of three places: that of its mesh, and
two that are offset perpendicular to the camera's line of sight. No fit is run: the media of the renders differ from the
truth by the errors that a fit leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from services.anatomy.dentin_shape import DentinShape
from services.anatomy.templates.incisor import build_incisor
from services.core.geometry import Camera, Light, Mesh
from services.fit.checks.offset import MAX_OFFSET_MM, Comparison
from services.fit.passes.evaluate import error_sums
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.reflection import reflect
from services.phantom.render import render_engine
from services.phantom.subjects import subject_tissues
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium, Tissue
from services.transport.scene.recipe import single_tooth

Array = NDArray[np.float64]

CHANNEL = ("green",)
LIGHTS = 5
PHOTOGRAPH_PATHS = 2048
"""Paths per pixel of a photograph, which leave 2.5 % of noise."""
RENDER_PATHS = (32, 128, 512)
"""Paths per pixel of each of the two renders that a fit compares, from a quick fit to a long one: up to 30 % of noise,
with rare bright pixels."""
LEFT_SCATTERING, LEFT_ABSORPTION = 0.1, 0.3
"""Standard deviations of the difference in ln σs' and ln σa between the render's media and the photographs' media, as
large as the errors of fits to few noisy images."""
ASSUMED, FLOOR = 0.01, 0.002
"""Standard deviations of the noise that is assumed for a capture that states none, as fractions of the value and of the
brightest pixel. All photographs have noise of the second kind."""


@dataclass(frozen=True)
class Place:
    """Noise-free photographs of one place of the tooth."""

    images: Array
    """Radiance (L, H, W)."""
    variances: Array
    """Monte Carlo variance of ``images``."""


@dataclass(frozen=True)
class Noise:
    """A sensor's noise, and the noise that the capture states."""

    share: float
    """Standard deviation as a fraction of the value, or of the brightest pixel where ``is_constant``."""
    is_constant: bool
    """Whether the noise is the same in dark and bright pixels: a share of the brightest pixel of all images."""
    is_stated: bool
    """Whether the capture states the noise; otherwise the default is assumed, 1 % of the value."""

    def variance(self, images: Array) -> Array:
        """True variance of each pixel (L, H, W)."""
        brightest = float(images.max())
        return (self.share * (brightest if self.is_constant else images)) ** 2 + (FLOOR * brightest) ** 2 + 0 * images

    def stated_variance(self, images: Array) -> Array:
        """Variance (L, H, W) that the registration check receives."""
        return self.variance(images) if self.is_stated else (ASSUMED * images) ** 2 + (FLOOR * images.max()) ** 2


class Photographed(NamedTuple):
    """Input of the registration check."""

    comparisons: list[Comparison]
    error: float
    """Relative image error."""


@dataclass(frozen=True)
class Phantom:
    """One tooth in front of one camera."""

    pixels: NDArray[np.int64]
    """Coordinates (N, 2), x and y, of the pixels that show the mesh."""
    pixel_mm: float
    renders: Array
    """Two independent renders (2, L, H, W) as in a fit's last evaluation; NaN where the mesh is not visible."""
    in_place: Place
    beside: tuple[Place, ...]

    def photographed(self, place: Place, noise: Noise, rng: np.random.Generator) -> Photographed:
        """Photograph a place under the brightest light and under the last one, which is held out, with new noise."""
        shown = [int(np.argmax(place.images[:-1].sum(axis=(1, 2)))), LIGHTS - 1]
        images, (first, second) = place.images[shown], self.renders[:, shown]
        drawn, stated = (noise.variance(place.images)[shown], noise.stated_variance(place.images)[shown])
        photos, said = images + np.sqrt(drawn) * rng.standard_normal(drawn.shape), stated + place.variances[shown]
        pairs = zip(photos, said, (first + second) / 2, np.abs(first - second) / 2, strict=True)
        x, y = self.pixels.T
        a, b, reference, variance = (stack[:, y, x] for stack in (first, second, photos, said))
        sums = error_sums(a, b, reference, variance, np.ones(a.shape, dtype=bool))
        return Photographed([Comparison(*pair) for pair in pairs], sums.resolved_error or 0.0)


def rendered_phantom(seed: int, number: int, offset_mm: float = 1.0) -> Phantom:
    """Render one phantom of a series; the same seed and number give the same phantom."""
    rng, incisor = np.random.default_rng([seed, number]), build_incisor()
    paths, with_gums = RENDER_PATHS[number % len(RENDER_PATHS)], number % 2 == 1
    turn, size = Rotation.from_rotvec(np.radians(rng.uniform(-15, 15, 3))), rng.uniform(0.85, 1.15)
    meshes = incisor.outer, incisor.dentin, incisor.gums
    outer, dentin, gums = (Mesh(turn.apply(size * mesh.vertices_mm), mesh.faces) for mesh in meshes)
    lights = dome_lights(LIGHTS, CHANNEL, int(rng.integers(2**31)))
    positions = np.array([light.position_mm for light in lights])
    intensities = np.array([light.intensity[0] for light in lights])
    recipe = single_tooth(outer, DentinShape.known(dentin), positions, intensities, "matched", 1.0)
    scene = _Scene(outer, gums if with_gums else None, lights, Engine(recipe))

    pixel_mm = rng.uniform(0.5, 0.8)
    # The margin is none, as for other phantoms, or the reach of the search for offsets.
    margin_px = rng.choice([0, round(MAX_OFFSET_MM / pixel_mm)])
    camera = _with_margin(dome_cameras(3, pixel_mm, (outer,))[rng.integers(3)], int(margin_px))
    truth = subject_tissues(int(rng.integers(2**31)), CHANNEL)["green"]
    media = Tissue(_isotropic(truth.enamel), _isotropic(truth.dentin))
    fitted = Tissue(_left(truth.enamel, rng), _left(truth.dentin, rng))
    first = rng.uniform(0, 2 * np.pi)
    across = [offset_mm * np.array([np.cos(angle), np.sin(angle)]) for angle in (first, first + np.pi / 2)]
    cameras = [camera, *(_moved(camera, by_mm) for by_mm in across)]

    shows = scene.shows_tooth(camera)
    renders = [scene.rendered(camera, fitted, paths, int(rng.integers(2**31))).images for _ in range(2)]
    in_place, *beside = (scene.rendered(one, media, PHOTOGRAPH_PATHS, int(rng.integers(2**31))) for one in cameras)
    pixels = np.argwhere(shows)[:, ::-1].astype(np.int64)
    return Phantom(pixels, pixel_mm, np.where(shows, np.stack(renders), np.nan), in_place, tuple(beside))


@dataclass(frozen=True)
class _Scene:
    outer: Mesh
    gums: Mesh | None
    lights: tuple[Light, ...]
    engine: Engine

    def shows_tooth(self, camera: Camera) -> NDArray[np.bool_]:
        """Pixels (H, W) that visible enamel fills; the preparation masks those at the gums' edge."""
        surface = reflect(self.outer, self.gums, camera, self.lights[:1], CHANNEL, 1.0)
        return np.asarray(surface.enamel_pixels & (surface.enamel_share > 1 - 1e-9))

    def rendered(self, camera: Camera, tissue: Tissue, paths: int, seed: int) -> Place:
        """Render the images of all lights."""
        surface = reflect(self.outer, self.gums, camera, self.lights, CHANNEL, 1.0)
        mean, variance = render_engine(self.engine, tissue, camera, surface.enamel_pixels, paths, seed)
        return Place(mean * surface.enamel_share + surface.gums[..., 0], variance * surface.enamel_share**2)


def _isotropic(medium: Medium) -> Medium:
    # The same reduced scattering and absorption with isotropic scattering: similar images with a quarter of the noise.
    scattering = medium.sigma * medium.alpha * (1 - medium.beta * medium.g1 - (1 - medium.beta) * medium.g2)
    extinction = scattering + medium.sigma * (1 - medium.alpha)
    return Medium(extinction, scattering / extinction, g1=0.0)


def _left(medium: Medium, rng: np.random.Generator) -> Medium:
    scattering = medium.sigma * medium.alpha * np.exp(LEFT_SCATTERING * rng.standard_normal())
    absorption = medium.sigma * (1 - medium.alpha) * np.exp(LEFT_ABSORPTION * rng.standard_normal())
    return replace(medium, sigma=float(scattering + absorption), alpha=float(scattering / (scattering + absorption)))


def _moved(camera: Camera, by_mm: Array) -> Camera:
    # Move the camera perpendicular to its line of sight, to the right and down; the tooth's image moves left and up.
    pose = np.array(camera.camera_from_world)
    pose[:2, 3] -= by_mm
    rows: Any = tuple(map(tuple, pose.tolist()))
    return camera.model_copy(update={"camera_from_world": rows})


def _with_margin(camera: Camera, margin_px: int) -> Camera:
    # Enlarge the image by a margin on every side.
    (fx, skew, cx), (_, fy, cy), last = camera.K
    width, height = camera.size
    K = ((fx, skew, cx + margin_px), (0.0, fy, cy + margin_px), last)
    return camera.model_copy(update={"size": (width + 2 * margin_px, height + 2 * margin_px), "K": K})
