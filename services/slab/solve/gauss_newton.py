"""The default solver: Gauss-Newton on normal equations from pairs of batches, in the unknowns of a dictionary.

init        a material and its normal equations
step        a scale of the prior by evidence, a damped step, judged on the unbiased misfit of fresh batches
terminate   the step promises no more than noise does, or the budget of steps is spent
finish      more steps, in stages of many more paths
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.slab.cell.dictionary import Material
from services.slab.cell.forward import Blocks, render
from services.slab.cell.rig import Rig
from services.slab.read.images import Measurements
from services.slab.solve.budget import Budget, Stage
from services.slab.solve.checkpoint import Checkpoint, Checkpoints, CombinedRenders
from services.slab.solve.coordinates import Coordinates
from services.slab.solve.measured_directions import broad_step, noise_ratio, step_matrix
from services.slab.solve.normal import Each, NormalEquations, ResidualSums, normal_equations
from services.slab.solve.prior import Quadratic, is_thick
from services.slab.solve.smooth import Smoother, smoother_of
from services.slab.solve.solution import Solution
from services.slab.solve.step_length import MAX_HALVINGS, noise_fall, predicted_fall, shortened
from services.slab.solve.uncertainty import largest_move, uncertainty_of
from services.slab.solve.weights import smoothed_covariance, weights_of

Array = NDArray[np.float64]

TOLERATED_RISE = 2.0
"""Number of standard errors by which the objective may rise: fewer would refuse good steps whose comparison is
noisy."""
TOLERATED_MISFIT_SHARE = 0.5
"""Share of the misfit by which it may rise in a thick cell: weights there come mostly from the paths' noise and are
estimated anew for each render, and misfits of one medium were seen to differ by a third. Otherwise a low misfit would
refuse all steps after it."""
PROMISE_RATIO, PROMISE_RATIO_THICK = 2.0, 1.0
"""Ratio of the fall of the objective that a step promises to the fall that noise alone promises. In the search a step
below the first value waits for more paths; in the last stages a step above it is followed by another. There the second
value holds in a thick cell, because the error left in sigma_s at a constant sigma_s' promises little beside the noise
of all directions, and is still a tenth of sigma_s."""
UNCONVERGED_RATIO = 5.0
"""The same ratio, above which the last step shows that the fit has not converged."""
FAR_RATIO = 50.0
"""The same ratio, above which a thin cell's fit returns to the search, whose steps are judged by the misfit. Steps of
the last stages that begin far from the minimum are mostly noise of the matrix: one fit went from 7.2 of an extinction
of 3 per mm to 2.8, where it was thin, and then to and fro. Of three other fits the largest ratio was 8."""
MAX_STEPS_BEFORE_RETURN = 30
"""Number of steps of a fit after which it returns to no search."""
SETTLED_MOVE = 1 / 3
"""Largest change of a reported value by the last step, in its standard errors, at which a fit has converged whatever
the step promises. Promises are compared with the noise of the paths alone, and where many renders are combined that is
far below the noise of the images: steps then promise several times as much and change nothing that is reported."""
MAX_COMBINED_CHANGE = 0.05
"""Largest distance in ln sigma_s at which residuals of several media are combined: the nonlinear part is then below a
thousandth."""
MAX_PATH_VARIANCE = 0.5
"""Largest variance by the paths, in units of that by the measurements, at which the last stage may end."""
MAX_THICKNESS = 50.0
"""Value of sigma_t w above which a fit ends: five times the thickest cell that tells a phase function. Images in a
wrong unit drove it up without end, and paths scatter for longer with every step."""
DAMPING = 1.0
"""Levenberg term in units of the noise of J: with 0.3 and with 3 the end was the same within its noise, with 0.05 it
strayed."""


@dataclass(frozen=True)
class State:
    """One point of the iteration."""

    material: Material
    equations: NormalEquations
    paths: int
    damping: float


@dataclass
class GaussNewton:
    """One fit; ``renders`` numbers the random streams."""

    rig: Rig
    measured: Measurements
    seed: int
    budget: Budget
    blocks: Blocks
    coordinates: Coordinates
    renders: int = 0
    paths: int = 0
    path_noise: tuple[Array, ...] | None = None
    """Monte Carlo covariance of one path for each light (pixels, C, C), a running mean over earlier renders."""
    multiple: Array | None = None
    """Light that has scattered twice and more (images, pixels), the same running mean."""
    combined: CombinedRenders | None = None
    """Renders of this stage that later ones are combined with, in a thick cell."""
    is_searching: bool = False
    """Whether the fit may still be far off: then steps use smooth derivatives and broad directions in any cell."""
    checkpoints: Checkpoints | None = None
    """File that stores the state of the fit and from which the fit continues; None for neither."""
    each: Each = map
    """See ``normal_equations``."""

    def solve(self, guess: Callable[[], Material]) -> Solution:
        """The solution, from a guess, or from the state that an earlier attempt saved before a step of the last
        stages.
        """
        checkpoint = None if self.checkpoints is None else self.checkpoints.read()
        if checkpoint is None:
            return self.finish(self.search(guess()))
        self.renders, self.paths, self.path_noise = checkpoint.renders, checkpoint.paths, checkpoint.path_noise
        self.multiple, self.combined = checkpoint.multiple, checkpoint.combined
        return self.finish(checkpoint)

    def search(self, material: Material) -> Checkpoint:
        """Iterate with few paths, until a step promises no more than their noise does or the budget of steps is
        spent.
        """
        self.is_searching = True
        state = self.init(self.coordinates.initial_medium(material))
        steps = 0
        converged = False
        while steps < self.budget.max_steps and not converged and not self.is_astray(state.material):
            state, converged = self.step(state)
            steps += 1
        self.is_searching = False
        assert self.path_noise is not None
        assert self.multiple is not None
        return Checkpoint(
            state.material, 0, 0, steps, converged, self.renders, self.paths, self.path_noise, self.multiple, None
        )

    def init(self, material: Material) -> State:
        """The first point of the iteration."""
        paths = self.budget.first_paths
        return State(material, self.linearised(material, paths, self.budget.batches), paths, DAMPING)

    def step(self, state: State) -> tuple[State, bool]:
        """One step, and whether the search has come as far as the noise of its paths allows."""
        x = self.coordinates.unknowns(state.material)
        quadratic = quadratic_at(x, state.equations)
        prior = self.coordinates.precision(self.coordinates.scale(state.material, quadratic, sharp=False))
        change = self.damped_step(quadratic, prior, state.equations, state.material, state.damping)
        promise = predicted_fall(quadratic, prior, x, change)
        noise = noise_fall(quadratic, prior, state.equations.gradient_noise)
        if promise < PROMISE_RATIO * noise and state.paths >= self.budget.search_paths:
            return state, True
        paths = min(2 * state.paths, self.budget.search_paths) if promise < PROMISE_RATIO * noise else state.paths
        if paths > state.paths and self.is_thick(state.material):
            # Weights there come mostly from the paths' noise, so misfits of different numbers of paths cannot be
            # compared.
            again = self.linearised(state.material, paths, self.budget.batches)
            return State(state.material, again, paths, state.damping), False
        before = state.equations.misfit + 0.5 * float(x @ prior @ x)
        differs = TOLERATED_MISFIT_SHARE * abs(state.equations.misfit) if self.is_thick(state.material) else 0.0
        for halving in range(MAX_HALVINGS + 1):
            y = x + change / 2**halving
            moved = self.coordinates.material_at(y)
            equations = self.linearised(moved, paths, self.budget.batches)
            after = equations.misfit + 0.5 * float(y @ prior @ y)
            spread = float(np.hypot(state.equations.misfit_se, equations.misfit_se))
            if after <= before + TOLERATED_RISE * spread + differs:
                return State(moved, equations, paths, max(state.damping / 4, DAMPING)), False
        more = min(2 * state.paths, self.budget.search_paths)
        return State(
            state.material, self.linearised(state.material, more, self.budget.batches), more, 4 * state.damping
        ), False

    def finish(self, checkpoint: Checkpoint) -> Solution:
        """Take the steps of the last stages, each stage until its steps promise no more than noise does."""
        while checkpoint.stage < len(self.budget.last):
            if self.checkpoints is not None:
                self.checkpoints.write(checkpoint)
            material, stage = checkpoint.material, self.budget.last[checkpoint.stage]
            is_thick, is_last = self.is_thick(material), checkpoint.stage + 1 == len(self.budget.last)
            # Weights of a thin cell contain the noise of all renders that the last stage may combine.
            share = 1 / stage.thin_steps if is_last and not is_thick and self.combines(material) else 1.0
            equations = self.linearised(
                material, stage.paths, stage.batches, combine=is_thick or is_last, noise_share=share
            )
            x = self.coordinates.unknowns(material)
            # Where residuals of nearby media are combined, the gradient is that at the mean of these media.
            centre = equations.residuals.place if self.combines(material) else x
            quadratic = quadratic_at(centre, equations)
            scale = self.coordinates.scale(material, quadratic, sharp=not self.is_thick(material))
            prior = self.coordinates.precision(scale)
            change = self.damped_step(quadratic, prior, equations, material, DAMPING)
            moved = self.coordinates.material_at(x + shortened(change, quadratic, prior, x, self.coordinates))
            gain = predicted_fall(quadratic, prior, x, change) / noise_fall(quadratic, prior, equations.gradient_noise)
            path_variance = 0.0
            if is_last and self.combines(material):
                data = noise_fall(quadratic, prior, equations.data_noise)
                path_variance = noise_fall(quadratic, prior, equations.gradient_noise) / data
            solution = Solution(
                moved, quadratic, equations.gradient_noise, scale, equations.used, checkpoint.steps + 1,
                False, self.paths, self.coordinates, equations.misfit, equations.misfit_se, equations.data_noise,
                equations.matrix_error @ (self.coordinates.unknowns(moved) - x), path_variance,
            )  # fmt: skip
            if self.is_far(moved, gain, checkpoint.steps):
                self.combined = None
                again = self.search(moved)
                checkpoint = replace(again, steps=checkpoint.steps + 1 + again.steps)
                continue
            is_settled = False
            if is_last and gain >= PROMISE_RATIO and path_variance < MAX_PATH_VARIANCE:
                errors = uncertainty_of(solution, with_remaining=False)
                is_settled = largest_move(material, moved, errors) < SETTLED_MOVE
            checkpoint = self.next_checkpoint(checkpoint, stage, moved, gain, path_variance, is_settled=is_settled)
            if self.is_astray(moved):
                break
        # A negative promise comes of a matrix that is mostly noise, and tells as little as a large one.
        is_near = abs(gain) < UNCONVERGED_RATIO or is_settled
        return replace(solution, converged=is_near and not self.is_astray(moved))

    def next_checkpoint(
        self,
        checkpoint: Checkpoint,
        stage: Stage,
        moved: Material,
        gain: float,
        path_variance: float,
        *,
        is_settled: bool,
    ) -> Checkpoint:
        """The state before the next step of the stage, or before the first of the next stage where this one has ended.

        Args:
            gain: fall that the last step promised, in units of the fall that noise alone promises.
            path_variance: variance by the paths in units of that by the measurements, where residuals of the last
                stage's renders are combined; else 0.
            is_settled: whether the last step moved no reported value by much of its standard error.
        """
        thick = self.is_thick(moved)
        min_gain, max_steps = PROMISE_RATIO_THICK if thick else PROMISE_RATIO, stage.max_steps(thick=thick)
        is_near = abs(math.log(moved.scattering_per_mm / checkpoint.material.scattering_per_mm)) < MAX_COMBINED_CHANGE
        is_over = (
            (gain < min_gain or is_settled) and path_variance < MAX_PATH_VARIANCE and (is_near or not thick)
        ) or checkpoint.step + 1 >= max_steps
        assert self.path_noise is not None
        assert self.multiple is not None
        if is_over:
            self.combined = None  # the next stage has batches of another size
        return replace(
            checkpoint,
            material=moved,
            stage=checkpoint.stage + is_over,
            step=0 if is_over else checkpoint.step + 1,
            steps=checkpoint.steps + 1,
            renders=self.renders,
            paths=self.paths,
            path_noise=self.path_noise,
            multiple=self.multiple,
            combined=self.combined,
        )

    def is_thick(self, material: Material) -> bool:
        """Whether cameras of one side see nearly the same of every path, so that sigma_s and g are hardly told
        apart.
        """
        return is_thick(material, self.rig.width_mm)

    def is_far(self, material: Material, gain: float, steps: int) -> bool:
        """Whether a fit in the last stages returns to the search.

        Args:
            material: where the last step led.
            gain: fall that the last step promised, in units of the fall that noise alone promises.
            steps: number of the fit's steps so far.
        """
        return abs(gain) > FAR_RATIO and not self.is_thick(material) and steps < MAX_STEPS_BEFORE_RETURN

    def is_astray(self, material: Material) -> bool:
        """Whether the fit has gone to media whose images no fit explains."""
        return material.extinction_per_mm * self.rig.width_mm > MAX_THICKNESS

    def damped_step(
        self, quadratic: Quadratic, prior: Array, equations: NormalEquations, around: Material, damping: float
    ) -> Array:
        """The step to the damped minimum, in which no unknown moves further than the linearisation holds.

        The Levenberg term is centred on the present point and holds directions whose curvature may be noise. It moves
        no fixed point, so that repeated steps from fresh paths end where an undamped one would.
        """
        x, broad = self.coordinates.unknowns(around), self.coordinates.broad_directions()
        noise = equations.gradient_noise + equations.data_noise
        if not self.is_broad(around):
            broad = broad[
                :, :0
            ]  # near the end of a thin cell's fit signals stand out, and a second step only adds noise
        if broad.size:
            damping *= max(1.0, noise_ratio(quadratic, prior, noise))
        matrix = step_matrix(quadratic, prior, damping)
        slope = quadratic.linear + (quadratic.matrix + prior) @ x
        first = x + self.coordinates.clipped_step(self.coordinates.minimum(matrix, matrix @ x - slope) - x, around)
        if not broad.size:
            return self.coordinates.clipped_step(first - x, around)
        reach = self.coordinates.broad_standard_deviations(around)
        second = first + broad_step(quadratic, prior, broad, reach, noise, first)
        if second[-1] < 0:
            # Absorption cannot be negative: set it to zero, and minimise over the others.
            first[-1] = 0
            second = first + broad_step(quadratic, prior, broad[:, :-1], reach[:-1], noise, first)
        return self.coordinates.similarity_step(self.coordinates.clipped_step(second - x, around), around)

    def linearised(
        self, material: Material, paths: int, batches: int, *, combine: bool = False, noise_share: float = 1.0
    ) -> NormalEquations:
        """Normal equations of fresh batches.

        Args:
            combine: whether derivatives of the stage's earlier renders are added. Weights then stay those of the first
                of them.
            noise_share: share of the variance by this number of paths that the weights contain.
        """
        self.renders += 1
        self.paths += paths * batches * len(self.rig.lights)
        estimates = render(
            self.rig,
            material,
            seed=self.seed,
            step=self.renders,
            batches=batches,
            paths=paths,
            scores=True,
            blocks=self.blocks,
        )
        shape, images = (self.rig.grid.rows, self.rig.grid.columns), [views.images for views in self.rig.lights]
        own = tuple(smoothed_covariance(estimates.images[:, index], shape) * batches * paths for index in images)
        # Weights come from earlier renders alone: rare bright paths raise a pixel and its variance together, and
        # weights that share them with the residuals raised sigma_s' by several per cent.
        recent = own if self.path_noise is None else self.path_noise
        earlier = self.combined if combine else None
        known = recent if earlier is None else earlier.path_noise
        variances = np.where(self.measured.held_out[:, None], np.inf, self.measured.variances)
        multiple = estimates.mean - estimates.single_images
        before = multiple if self.multiple is None else self.multiple
        if self.is_broad(material):
            estimates = self.smoother(before, variances, [one / (batches * paths) for one in recent]).of(estimates)
        self.multiple = (multiple + before) / 2
        noise = [noise_share * one / (batches * paths) for one in known]
        if not (combine or self.is_thick(material)):
            # The few batches of the search estimate the correlation of cameras too roughly for weights of a thin cell,
            # in which the paths' noise is not nearly all of it.
            noise = [one * np.eye(one.shape[1]) for one in noise]
        weights = weights_of(images, variances, noise)
        self.path_noise = tuple((first + second) / 2 for first, second in zip(own, recent, strict=True))
        equations = normal_equations(
            estimates,
            material,
            self.measured.values,
            weights,
            None if earlier is None else earlier.derivatives,
            self.nearby_residuals(earlier, material),
            self.each,
        )
        self.combined = CombinedRenders(equations.derivatives, equations.residuals, known) if combine else None
        return equations.chained(self.coordinates.chain(material))

    def is_broad(self, material: Material) -> bool:
        """Whether derivatives are smoothed, and a second step goes along broad directions."""
        return self.is_thick(material) or (self.is_searching and self.combines(material))

    def combines(self, material: Material) -> bool:
        """Whether the unknowns are ln f and sigma_a themselves, in which residuals of several media can be combined."""
        return self.coordinates.chain(material) is None

    def nearby_residuals(self, earlier: CombinedRenders | None, material: Material) -> ResidualSums | None:
        """Residuals of earlier renders, where their media are so near that derivatives can carry them over to this one;
        else None.
        """
        if earlier is None or not self.combines(material):
            return None
        place = self.coordinates.material_at(earlier.residuals.place)
        moved = abs(math.log(material.scattering_per_mm / place.scattering_per_mm))
        return earlier.residuals if moved < MAX_COMBINED_CHANGE else None

    def smoother(self, multiple: Array, variances: Array, noise: list[Array]) -> Smoother:
        """Smoother of derivatives, made from earlier renders; ``noise`` as the covariances of ``weights_of``."""
        own = np.zeros_like(variances)
        for views, one in zip(self.rig.lights, noise, strict=True):
            own[views.images] = np.einsum("pii->ip", one)
        return smoother_of(self.rig.grid, self.rig.width_mm, multiple, variances + own)


def quadratic_at(x: Array, equations: NormalEquations) -> Quadratic:
    """The model of half the misfit in the unknowns themselves, from equations linearised at ``x``."""
    return Quadratic(
        equations.matrix,
        equations.gradient - equations.matrix @ x,
        equations.noise,
        equations.noise_gradient - equations.noise @ x,
        equations.matrix_error,
    )
