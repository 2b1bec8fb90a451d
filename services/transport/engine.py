"""Public interface of the engine: one built scene, from which it computes images and Jacobians under all lights."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.optics.parameters import Mouth, Tissue
from services.transport.paths.until import MAX_SAMPLES, Effort, Sums, trace_until
from services.transport.platform import prepare_device
from services.transport.scene.checks import (
    require_cotangent,
    require_finite,
    require_finite_gradient,
    require_lights,
    require_rough,
    require_straight,
    require_surfaces,
    require_view,
)
from services.transport.scene.names import media_of, parameter_names, whitened
from services.transport.scene.recipe import (
    JacobianEstimate,
    SceneRecipe,
    ShapeGradient,
    StackEstimate,
    StainGradient,
    View,
)

if TYPE_CHECKING:
    from services.transport.gradients.shape_gradient import ShapeGradients
    from services.transport.lighting.lights import PointLights
    from services.transport.paths.scores import Plan
    from services.transport.paths.starts import CameraStart
    from services.transport.paths.walk import Walk
    from services.transport.scene.media import Media

LANE_BUDGET = 24_000_000
"""Largest number of float64 sums that a tally may hold, about 190 MB; larger requests are cut into slices of pixels."""


class Engine:
    """A scene built once per process; tissue parameters and dentin shape change per call without rebuilding it."""

    def __init__(self, recipe: SceneRecipe, threads: int | None = None) -> None:
        """Build the scene. It also selects the variant and the thread count if none is set yet.

        Raises:
            PlatformError: no usable libLLVM.
            MeshError: a surface cannot bound a medium.
            InputError: no usable light, or an index of refraction out of its range.
        """
        require_surfaces(recipe)
        reach_mm = float(np.linalg.norm(recipe.vertices_mm(), axis=1).max())
        require_lights(recipe.light_positions_mm, recipe.light_intensities, reach_mm)
        for name, ior, usual in (("ior", recipe.ior, "enamel, 1.631"), ("gums_ior", recipe.gums_ior, "gums, 1.33")):
            if not math.isfinite(ior) or ior < 1:
                raise InputError(f"{name} = {ior:g} must be at least 1; give the index of refraction of {usual}.")
        prepare_device(threads, recipe.device)
        from services.transport.boundary.models import mesh_boundary
        from services.transport.lighting.light_maps import LightMaps
        from services.transport.lighting.lights import PointLights
        from services.transport.lighting.lit_faces import LitFaces
        from services.transport.lighting.mouth_maps import MouthMaps
        from services.transport.scene.mesh_geometry import MeshGeometry

        self.recipe = recipe
        self._geometry = MeshGeometry(recipe)
        kind: type[LightMaps | LitFaces] = LightMaps if self._geometry.single else MouthMaps
        refracts = recipe.ior != 1 or (recipe.gums is not None and recipe.gums_ior != 1)
        if recipe.boundary == "rough" and refracts:
            require_rough(recipe)
        self._boundary = mesh_boundary(
            recipe.boundary, recipe.ior, refracts=refracts, roughness=recipe.roughness,
            gums_ior=None if recipe.gums is None else recipe.gums_ior, compensated=recipe.multiple_scattering,
        )  # fmt: skip
        if self._boundary.bends:
            kind = LitFaces
        maps = kind(recipe.light_positions_mm, recipe.light_intensities, recipe.vertices_mm())
        self._lights = PointLights(recipe.light_positions_mm, recipe.light_intensities, maps)
        self._lights_by_selection: dict[tuple[int, ...], PointLights] = {}
        self._shape_gradients: dict[int, ShapeGradients] = {}
        self._radius_mm = reach_mm
        self._lights.maps.trace(self._geometry, self._boundary)

    def images(
        self,
        tissue: Tissue | Mouth,
        view: View,
        *,
        seed: int,
        samples: int | None = None,
        rel_error: float | None = None,
        max_seconds: float = 600.0,
        max_samples: int = MAX_SAMPLES,
        batches: int = 16,
    ) -> StackEstimate:
        """Radiance of ``view``'s pixels under each light.

        Args:
            seed: together with camera, pixel and sample number it fixes every random number.
            samples: paths per pixel, rounded up to a multiple of ``batches``; fewer than ``batches`` make as many
                batches.
            rel_error: alternative to ``samples``: sqrt(sum of variances) / norm to reach over all pixels and lights of
                the view.
            max_seconds: with ``rel_error``, the time after which the estimate is returned as it is, with ``complete``
                false and its true error.
            max_samples: with ``rel_error``, the same limit in paths per pixel. A result that was not cut short by time
                repeats bit for bit.
            batches: independent batches whose spread gives the variance; one value's error follows Student's t with
                ``batches - 1`` degrees of freedom.

        Raises:
            InputError: a parameter is outside its physical range, the view lists no pixel, or not exactly one of
                ``samples`` and ``rel_error`` is given.
            NonFiniteError: a result is NaN or infinite.
        """
        from services.transport.paths.scores import Plan

        def summarise(tables: Sums) -> StackEstimate:
            mean, variance = self._expand_to_all_lights(view, *_mean_and_variance(tables[0]))
            return StackEstimate(mean, variance)

        effort = Effort(samples, rel_error, max_seconds, max_samples, batches)
        return trace_until(
            lambda numbers, batches: self._trace(tissue, view, Plan(), numbers, seed, batches), summarise, effort
        )

    def jacobian(
        self,
        tissue: Tissue | Mouth,
        view: View,
        names: tuple[str, ...],
        *,
        seed: int,
        samples: int | None = None,
        rel_error: float | None = None,
        max_seconds: float = 600.0,
        max_samples: int = MAX_SAMPLES,
        batches: int = 4,
    ) -> JacobianEstimate:
        """Images and their derivatives with respect to the natural parameters ``names`` (see ``Tissue``).

        Derivatives are scores of the same paths that make the images (optics.md); ``shape.k`` includes both border
        terms. Arguments are those of ``images``; ``rel_error`` is to be reached by the images and by each derivative,
        relative to its own norm. A derivative that is nothing but noise never reaches it, so set a limit.

        Raises:
            InputError: as ``images``; also for a name that the scene does not have, or shapes of several teeth at once.
            NonFiniteError: a result is NaN or infinite.
        """
        from services.transport.paths.scores import Plan
        from services.transport.scene.media import Score

        known = parameter_names(self.recipe)
        unknown = [name for name in names if name not in known]
        if unknown:
            raise InputError(f"Parameter {unknown[0]} does not exist in this scene; it has {', '.join(known)}.")
        media = [name for name in names if known[name].shape is None]
        moved = {tooth for name in names if (tooth := known[name].shape) is not None}
        if len(moved) > 1:
            raise InputError(f"Shapes of teeth {sorted(moved)} were asked for at once; ask for one tooth's at a time.")
        shape = next(iter(moved), None)
        plan = Plan(scores=tuple(Score(known[name].medium, known[name].field) for name in media), shape=shape)
        shapes = [name for name, parameter in known.items() if parameter.shape is not None and parameter.shape == shape]
        place = {name: k for k, name in enumerate(media + shapes, 1)}

        def summarise(tables: Sums) -> JacobianEstimate:
            mean, variance = self._expand_to_all_lights(view, *_mean_and_variance(tables[0]))
            pairs = [self._expand_to_all_lights(view, *_mean_and_variance(tables[place[name]])) for name in names]
            slopes, slope_variances = (
                np.stack([pair[k] for pair in pairs]) if pairs else np.zeros((0, *mean.shape)) for k in range(2)
            )
            return JacobianEstimate(names, mean, variance, slopes, slope_variances)

        effort = Effort(samples, rel_error, max_seconds, max_samples, batches)
        return trace_until(
            lambda numbers, batches: self._trace(tissue, view, plan, numbers, seed, batches), summarise, effort
        )

    def shape_gradient(
        self,
        tissue: Tissue | Mouth,
        view: View,
        cotangent: NDArray[np.float64],
        *,
        seed: int,
        samples: int,
        photons: int | None = None,
        order: int = 5,
        tooth: int = 0,
    ) -> ShapeGradient:
        """Derivatives of sum(cotangent x images) with respect to all weights of a tooth's dentin shape, with far less
        noise than the Jacobian's.

        It multiplies light and importance on the border (``border_series``) instead of following single paths. It has a
        bias: the series ends at ``order``, and light is averaged over patches of the border.

        Args:
            cotangent: (L, N) weight of every pixel under every light, such as an L2 loss's residual; rows of lights
                that the view does not list are ignored.
            samples: walks per pixel, rounded up to whole batches.
            photons: photons per light, rounded up likewise; by default as many over all lights as there are walks.
            order: highest degree of the spherical harmonics, 1 to 9.
            tooth: index of the tooth whose dentin moves.

        Raises:
            InputError: as ``images``; also for a scene without shape modes, phase tables, and a cotangent of another
                shape or not finite.
            NonFiniteError: the result is NaN or infinite.
        """
        from services.transport.gradients.shape_gradient import ShapeGradients

        require_straight(self.recipe, "the gradient to the dentin's shape")
        cotangent = np.asarray(cotangent, dtype=np.float64)
        if not 0 <= tooth < len(self.recipe.teeth) or self._geometry.modes_of[tooth] == 0:
            raise InputError(
                f"Tooth {tooth} has no dentin with shape modes, so there is no gradient to its shape; build it from a"
                " blend shape."
            )
        if not 1 <= order <= 9 or samples < 1 or (photons is not None and photons < 1):
            raise InputError(
                f"samples = {samples}, photons = {photons} and order = {order}: counts must be at least 1, and the"
                " order 1 to 9; correct them."
            )
        media, _ = self._prepare(tissue, view)
        require_cotangent(cotangent, view, self.recipe)
        moved = tissue if isinstance(tissue, Tissue) else tissue.teeth[tooth]
        if moved.enamel.table is not None or moved.dentin.table is not None:
            raise InputError(
                f"Tooth {tooth} has a phase table, and this gradient needs lobes; give it lobes, or take the"
                " Jacobian's."
            )
        if tooth not in self._shape_gradients:
            self._shape_gradients[tooth] = ShapeGradients(self._geometry, tooth, self._boundary, self._radius_mm)
        lights = len(view.lights or self.recipe.light_positions_mm)
        photons = photons or -(-samples * len(view) // lights)
        found = self._shape_gradients[tooth](
            moved, media, view, cotangent, seed=seed, samples=samples, photons=photons, order=order
        )
        require_finite_gradient("the dentin's shape", view, found.gradient, found.variance)
        return found

    def order_images(
        self,
        tissue: Tissue | Mouth,
        view: View,
        *,
        bin_edges: NDArray[np.int64],
        samples: int,
        seed: int,
        batches: int = 1,
    ) -> NDArray[np.float64]:
        """Images at albedo 1, split by scattering order: (K, L, N), where bin k holds paths with bin_edges[k] <=
        scatterings < bin_edges[k + 1].

        An image is a polynomial in a common albedo, and these are its coefficients; paths end at the last edge.
        """
        from services.transport.paths.scores import Plan

        white = whitened(tissue)
        plan, bins = Plan(order_edges=tuple(int(edge) for edge in bin_edges)), len(bin_edges) - 1
        batches, count = Effort(samples=samples, batches=batches).shares(samples)
        (sums,) = self._trace(white, view, plan, range(count), seed, batches)
        (orders,) = self._expand_to_all_lights(view, (sums / count).mean(axis=0).reshape(len(view), -1, bins).T)
        return orders

    def stain_gradient(
        self,
        tissue: Tissue | Mouth,
        view: View,
        cotangent: NDArray[np.float64],
        *,
        seed: int,
        samples: int,
        batches: int = 16,
    ) -> StainGradient:
        """Derivatives of sum(cotangent x images) with respect to every texel of the stains, in one pass that scores
        every stained face on a path, in and out (teeth 2018 Eq. 10).

        Args:
            cotangent: (L, N), such as the residual of an L2 loss; independent of this pass where the result is to be
                unbiased.

        Raises:
            InputError: as ``images``; also for a cotangent of another shape, or a scene without stains.
            NonFiniteError: the result is NaN or infinite.
        """
        from services.transport.paths.scores import Plan
        from services.transport.paths.stain_tally import StainTally
        from services.transport.paths.starts import CameraStart

        require_straight(self.recipe, "the gradient to stains")
        media, lights = self._prepare(tissue, view)
        require_cotangent(cotangent, view, self.recipe)
        textures = self._geometry.textures
        if textures is None:
            raise InputError("The scene has no stains to differentiate; give a tooth's tissue a stain.")
        listed_cotangent = cotangent if view.lights is None else cotangent[list(view.lights)]
        largest = float(np.abs(listed_cotangent).max())
        batches, count = Effort(samples=samples, batches=batches).shares(samples)
        tally = StainTally(textures, listed_cotangent / (largest or 1.0), batches)
        start = CameraStart(view, batches, seed, self._radius_mm)
        sums, _ = self._walk(media, lights, start, Plan(stains=True)).run(count, tally).arrays()
        require_finite_gradient("the stains", view, sums)
        means = sums * (largest / count)
        gradient, variance = (
            means.mean(axis=0),
            means.var(axis=0, ddof=1) / batches if batches > 1 else np.full(textures.count, np.nan),
        )
        return StainGradient(textures.split_by_tooth(gradient), textures.split_by_tooth(variance), batches * count)

    def _prepare(self, tissue: Tissue | Mouth, view: View) -> tuple[Media, PointLights]:
        """Check a request, update shapes and stains of the scene, and return the media and lights of its kernel."""
        from services.transport.scene.media import Media

        require_view(view, self.recipe)
        mouth = tissue if isinstance(tissue, Mouth) else Mouth((tissue,), tissue.gums)
        media = media_of(mouth, self.recipe)
        others = len(self.recipe.neighbours)
        reshaped = self._geometry.reshape((*(tuple(tooth.shape) for tooth in mouth.teeth), *[()] * others))
        if self._geometry.restain((*(tooth.stain for tooth in mouth.teeth), *[None] * others)) or reshaped:
            self._lights.maps.trace(self._geometry, self._boundary)
            self._lights_by_selection.clear()
        return Media(media), self._lights_of(view)

    def _trace(self, tissue: Tissue | Mouth, view: View, plan: Plan, numbers: range, seed: int, batches: int) -> Sums:
        """Sums of contributions, then of each derivative, over the sample numbers of every batch, each (batches, N,
        slots).
        """
        from services.transport.paths.starts import CameraStart

        media, lights = self._prepare(tissue, view)
        bins = max(len(plan.order_edges) - 1, 1)
        slots = lights.count * bins
        tables = 1 + len(plan.scores) + (0 if plan.shape is None else self._geometry.modes_of[plan.shape])
        slice_size = max(1, LANE_BUDGET // (batches * slots * tables))
        pieces = []
        for first in range(0, len(view), slice_size):
            piece = View(view.camera, view.pixels[first : first + slice_size])
            start = CameraStart(piece, batches, seed, self._radius_mm, skipped=numbers.start)
            sums, derivatives = self._walk(media, lights, start, plan).run(len(numbers)).arrays()
            pieces.append([array.reshape(batches, len(piece), slots) for array in (sums, *derivatives)])
        whole = [np.concatenate(arrays, axis=1) for arrays in zip(*pieces, strict=True)]
        require_finite(whole, view)
        return whole

    def _expand_to_all_lights(self, view: View, *arrays: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Arrays (..., lights of the view, N) extended to all lights, with zeros for lights that were not sampled."""
        if view.lights is None:
            return arrays
        whole = tuple(
            np.zeros((*array.shape[:-2], len(self.recipe.light_positions_mm), array.shape[-1])) for array in arrays
        )
        for target, array in zip(whole, arrays, strict=True):
            target[..., list(view.lights), :] = array
        return whole

    def _walk(self, media: Media, lights: PointLights, start: CameraStart, plan: Plan) -> Walk:
        from services.transport.paths.walk import Walk

        return Walk(self._geometry, media, lights, start, plan, self._boundary)

    def _lights_of(self, view: View) -> PointLights:
        """Lights that a view lists, or all; its kernel contains no others."""
        from services.transport.lighting.lights import PointLights

        if view.lights is None:
            return self._lights
        if view.lights not in self._lights_by_selection:
            chosen = list(view.lights)
            self._lights_by_selection[view.lights] = PointLights(
                self.recipe.light_positions_mm[chosen],
                self.recipe.light_intensities[chosen],
                self._lights.maps.subset(chosen),
            )
        return self._lights_by_selection[view.lights]


def _mean_and_variance(batches: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over batches (batches, N, L) and the variance of that mean, both (L, N); one batch has variance NaN."""
    count = len(batches)
    variance = batches.var(axis=0, ddof=1) / count if count > 1 else np.full(batches.shape[1:], np.nan)
    return batches.mean(axis=0).T, variance.T
