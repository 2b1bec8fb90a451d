"""Description from which the engine builds a scene: plain arrays, so that it pickles; the built scene never leaves its
process.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Camera, Mesh
from services.core.records import Boundary, Device
from services.core.results import RoughSurface
from services.core.surface.rough import DEFAULT_ROUGHNESS


@dataclass(frozen=True)
class ToothSurfaces:
    """One tooth: the surface around its enamel, and the shape of the dentin inside, if there is any."""

    outer: Mesh
    dentin: DentinShape | None = None
    stain_uv: NDArray[np.float64] | None = None
    """Texture coordinates of the outer faces' corners (F, 3, 2); None for a tooth that cannot have stains."""


@dataclass(frozen=True)
class SceneRecipe:
    """Teeth with their surroundings, their lights and their boundary model, for one colour channel.

    Where solids overlap, dentin counts over enamel over gums, and of two teeth the one listed first, of ``teeth``
    before ``neighbours``.
    """

    teeth: tuple[ToothSurfaces, ...]
    light_positions_mm: NDArray[np.float64]
    """(L, 3)"""
    light_intensities: NDArray[np.float64]
    """(L,) radiant intensity of this channel, mm as length unit."""
    boundary: Boundary = "matched"
    ior: float = 1.631
    device: Device | None = None
    """Device that traces the paths; None for the one that this process already uses, else the CPU."""
    gums: Mesh | None = None
    """The solid that holds the roots."""
    gums_ior: float = 1.33
    cavity: Mesh | None = None
    """The wall of the mouth behind the teeth, an opaque diffuse surface; it need not be closed."""
    neighbours: tuple[ToothSurfaces, ...] = ()
    """Further teeth around a single one, of the same media; their dentin does not move."""
    roughness: float = DEFAULT_ROUGHNESS
    """GGX roughness of a ``rough`` boundary."""
    multiple_scattering: bool = True
    """Whether a ``rough`` boundary gives back light that meets several of its facets; stock renderers lose it."""

    @property
    def all_teeth(self) -> tuple[ToothSurfaces, ...]:
        """All teeth, in the order in which they count where they overlap."""
        return self.teeth + self.neighbours

    def with_surface(self, surface: RoughSurface | None) -> SceneRecipe:
        """The scene with the rough surface that a fit has held; unchanged where it held none."""
        if surface is None:
            return self
        return replace(self, roughness=surface.roughness.value, multiple_scattering=surface.multiple_scattering)

    def vertices_mm(self) -> NDArray[np.float64]:
        """Vertices of all outer surfaces, (V, 3)."""
        meshes = [
            *(tooth.outer for tooth in self.all_teeth),
            *(mesh for mesh in (self.gums, self.cavity) if mesh is not None),
        ]
        return np.concatenate([mesh.vertices_mm for mesh in meshes])


def single_tooth(
    outer: Mesh,
    dentin: DentinShape | None,
    light_positions_mm: NDArray[np.float64],
    light_intensities: NDArray[np.float64],
    boundary: Boundary = "matched",
    ior: float = 1.631,
    device: Device | None = None,
) -> SceneRecipe:
    """A scene of one tooth and nothing else."""
    return SceneRecipe((ToothSurfaces(outer, dentin),), light_positions_mm, light_intensities, boundary, ior, device)


@dataclass(frozen=True)
class View:
    """The valid pixels of one camera, and the lights under which they are rendered."""

    camera: Camera
    pixels: NDArray[np.int32]
    """(N, 2) integer x, y of the valid pixels."""
    lights: tuple[int, ...] | None = None
    """Indices of the lights that contribute to some of these pixels; None for all. The others are not sampled: their
    images are 0 with variance 0."""

    def __len__(self) -> int:
        return len(self.pixels)


def relative_error(mean: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """sqrt(sum of variances) / norm: 0 where both are 0, NaN where there are no batches to compare."""
    spread, norm = float(np.sqrt(variance.sum())), float(np.linalg.norm(mean))
    if norm == 0:
        return 0.0 if spread == 0 else np.inf
    return spread / norm


@dataclass(frozen=True)
class StackEstimate:
    """Images of one view under all lights: mean and variance of the mean, both (L, N)."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    samples: int = 0
    """Paths per pixel of this estimate; 0 if not known."""
    complete: bool = True
    """Whether the requested error was reached before a limit was."""

    @property
    def rel_error(self) -> float:
        """sqrt(sum of variances) / norm over all pixels and lights."""
        return relative_error(self.mean, self.variance)


@dataclass(frozen=True)
class StainGradient:
    """Derivatives of sum(cotangent x images) with respect to the texels of each tooth's stain, (H, W) each, None for a
    tooth without stains; variances are of the means.
    """

    gradient: tuple[NDArray[np.float64] | None, ...]
    variance: tuple[NDArray[np.float64] | None, ...]
    samples: int


@dataclass(frozen=True)
class JacobianEstimate:
    """Images (L, N) and their derivatives (F, L, N) in the order of ``names``, from one seed; variances are of the
    means.
    """

    names: tuple[str, ...]
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    jacobian_variance: NDArray[np.float64]
    samples: int = 0
    """Paths per pixel of this estimate; 0 if not known."""
    complete: bool = True
    """Whether the requested error was reached before a limit was."""

    @property
    def rel_error(self) -> float:
        """The largest relative error of the images and of each derivative, each over its own norm, so that units of
        parameters do not matter.
        """
        pairs = [(self.mean, self.variance), *zip(self.jacobian, self.jacobian_variance, strict=True)]
        return float(np.max([relative_error(*pair) for pair in pairs]))


@dataclass(frozen=True)
class ShapeGradient:
    """Derivatives of a weighted sum of images with respect to the shape modes, (M,), and the variances of these
    means.
    """

    gradient: NDArray[np.float64]
    variance: NDArray[np.float64]
    samples: int
    """Paths per pixel of this estimate."""
