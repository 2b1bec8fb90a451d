"""The joint fit of a jaw's channel: all teeth, gums and the wall's colour at once, light passing between them (teeth
2018, section 7).

=========  ==============================================================  =======  ===========================
stage      free                                                            media    ends
=========  ==============================================================  =======  ===========================
start.k    sigma, alpha of enamel and dentin of each tooth and of gums,    similar  two steps each; for each tooth
           the wall's reflectance, from several ratios of the media                 the least loss of its own
joint      the same                                                        similar  converged, or max_steps
shape      the same, the mean cosine of all enamel, and each tooth's       exact    converged, or max_steps; only where
           blend weights                                                            blend weights are fitted
exact      the same                                                        exact    converged, or max_steps
again      the same                                                        exact    as before; only where errors
                                                                                    moved x far
=========  ==============================================================  =======  ===========================

Before the first stage every tooth was fitted alone, as if homogeneous. Which of its two media is the denser one is
decided with its surroundings in place: without gums and wall, their reflections would be attributed to the tooth.

Gain, lights and flare of the instrument, and the places of scan and dome, are common to all teeth. As in the fit of a
single tooth, they are taken into account in the stages of exact media.

Teeth with too few visible pixels, or whose own fit failed, have coordinates like all others, but with a Gaussian prior
about the median of the front teeth, which is updated before each stage. So the few pixels that show them still count,
and without any they follow the median.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from services.fit.coordinates.domain import Coordinate, Domain, similar_medium, similar_tissue, to_dual
from services.fit.coordinates.priors import COSINE, GUMS_SD, SHAPE, WEAK, priors_of
from services.fit.passes.final_uncertainty import HeldCosines
from services.fit.passes.neighbours import Neighbours
from services.fit.passes.passes import StackProblem
from services.fit.stages.channel_fit import ChannelFit, Stages
from services.fit.stages.jaw.starts import ToothStart, median_tissue
from services.fit.stages.tooth.schedule import EXACT_SAMPLES, SIMILAR_G, START_RATIOS, START_STEPS
from services.transport.optics.parameters import Mouth, Tissue

TIED_SD = {"sigma": 0.2, "alpha": 0.15}
"""Standard deviations of the teeth of one mouth about their median, in the unbounded domain: 20 % of sigma, 35 % of 1 -
alpha."""
WALL_SD = 1.5
"""Prior standard deviation of the logit of the wall's reflectance about its start."""


@dataclass(kw_only=True)
class JawSchedule(Stages[Mouth]):
    """The stages of one channel of a jaw."""

    start: Mouth
    teeth: Sequence[ToothStart]
    dentin: Sequence[bool]
    """Whether each tooth has dentin."""
    fits_shape: bool = True
    """Whether blend weights, where there are any, are fitted."""

    def run(self) -> ChannelFit[Mouth]:
        """Fit the channel."""
        samples = self.spec.samples_per_pixel
        options = self.similar_media_options(self.options(self.files.coarse))
        mouth = self._best_starts() if any(self.dentin) else self.start
        mouth, solution = self._iterate(self._problem(mouth, "joint", SIMILAR_G), options, 2 * samples)
        if self._shaped:
            mouth, solution = self._iterate(
                self._problem(self._with_updated_ties(mouth), "shape", None),
                self.options(self.files.coarse),
                solution.samples,
            )
        options = self.switch_to_full_resolution()
        exact = self._problem(self._with_updated_ties(mouth), "exact", None)
        mouth, solution = self._iterate(
            exact, options, self.full_image_samples(min(solution.samples, EXACT_SAMPLES * samples))
        )
        return self._finish(replace(exact, base=mouth, stage="final"), solution)

    def _problem(self, mouth: Mouth, stage: str, image_g: float | None) -> StackProblem[Mouth]:
        domain = self._domain(mouth) if image_g is not None else self._exact_domain(mouth)
        neighbours = Neighbours.of([start.fdi for start in self.teeth])
        return StackProblem(
            self.passes, domain, mouth, stage, jacobian_g=SIMILAR_G, image_g=image_g, neighbours=neighbours
        )

    def _best_starts(self) -> Mouth:
        # Fit every ratio for all teeth at once, then compare the losses tooth by tooth, with the same seeds.
        ends = []
        for k, ratio in enumerate(START_RATIOS):
            start = replace(self.start, teeth=tuple(map(partial(_layered, ratio), self.start.teeth, self.dentin)))
            ends.append(
                self._iterate(
                    self._problem(start, f"start.{k}", SIMILAR_G),
                    self.preparatory_options(START_STEPS),
                    self.spec.samples_per_pixel,
                )[0]
            )
        samples = min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel)

        def compute() -> list[list[float]]:
            found = [
                self._evaluate("starts", similar_tissue(end, SIMILAR_G), samples, self.files.coarse) for end in ends
            ]
            whole = [each.fitted.product for each in found]
            return [
                [
                    each.parts[k][0].product if k in each.parts else total
                    for each, total in zip(found, whole, strict=True)
                ]
                for k in range(len(self.teeth))
            ]

        self.raise_if_cancelled()
        losses, _ = self.journal.get_or_compute(f"{self.scope}/starts", compute)
        best = [ends[int(np.argmin(own))].teeth[k] for k, own in enumerate(losses)]
        return replace(ends[int(np.argmin(np.sum(losses, axis=0)))], teeth=tuple(best))

    @property
    def media(self) -> tuple[str, ...]:
        """See Stages."""
        teeth = [
            f"{k}.{part}"
            for k, has_dentin in enumerate(self.dentin)
            for part in (("enamel", "dentin") if has_dentin else ("enamel",))
        ]
        return (*teeth, *(() if self.start.gums is None else ("gums",)))

    @property
    def part_count(self) -> int:
        """See Stages."""
        return len(self.teeth)

    def _held_cosines(self, domain: Domain) -> HeldCosines:
        # The mean cosines of one tissue's media share one error: with errors of their own, 29 media would cost more
        # than the fit.
        kinds = {"enamel": WEAK["enamel.g1"], "dentin": WEAK["dentin.g1"], "gums": WEAK["enamel.g1"]}
        held = [part for part in self.media if part not in domain.cosines]
        by_kind = {
            tuple(part for part in held if part.rpartition(".")[2] == kind): prior for kind, prior in kinds.items()
        }
        return {parts: prior for parts, prior in by_kind.items() if parts}

    def _other_values(self, tissue: Mouth) -> dict[str, float]:
        shapes = {f"{k}.shape.{mode}": c for k, tooth in enumerate(tissue.teeth) for mode, c in enumerate(tooth.shape)}
        return shapes | ({} if tissue.reflectance is None else {"cavity.reflectance": tissue.reflectance})

    def _reported_name(self, name: str) -> str:
        # Name with the tooth's FDI number, where the fit uses its position in the list.
        position, _, own = name.partition(".")
        return f"{self.teeth[int(position)].fdi}.{own}" if position.isdigit() else name

    def _domain(self, mouth: Mouth) -> Domain:
        common = Mouth((self._median_tissue(mouth),))
        coordinates = []
        for part in self.media:
            tooth, _, medium = part.rpartition(".")
            for kind in ("sigma", "alpha"):
                name = f"{part}.{kind}"
                if part == "gums":
                    coordinates.append(Coordinate((name,), to_dual(kind, self.start.value(name)), GUMS_SD[kind]))
                elif self.teeth[int(tooth)].state != "fitted":
                    coordinates.append(
                        Coordinate((name,), to_dual(kind, common.value(f"0.{medium}.{kind}")), TIED_SD[kind])
                    )
                else:
                    prior = priors_of(self.spec.prior).get(f"{medium}.{kind}")
                    coordinates.append(Coordinate((name,), *prior) if prior else Coordinate((name,)))
        if mouth.reflectance is not None:
            assert self.start.reflectance is not None
            coordinates.append(
                Coordinate(("cavity.reflectance",), to_dual("reflectance", self.start.reflectance), WALL_SD)
            )
        return Domain(tuple(coordinates))

    def _exact_domain(self, mouth: Mouth) -> Domain:
        # Add one mean cosine for the enamel of a mouth, which images of similar media would not show, and the blend
        # weights; tied teeth keep those of the start.
        enamel = tuple(f"{k}.enamel.cosine" for k in range(len(mouth.teeth)))
        weights = [f"{k}.shape.{mode}" for k in self._shaped for mode in range(len(mouth.teeth[k].shape))]
        return Domain(
            (
                *self._domain(mouth).coordinates,
                Coordinate(enamel, *COSINE),
                *(Coordinate((name,), *SHAPE) for name in weights),
            ),
            self.files.errors,
        )

    @property
    def _shaped(self) -> list[int]:
        # Positions of the teeth whose blend weights are fitted.
        return [
            k
            for k, tooth in enumerate(self.start.teeth)
            if tooth.shape and self.fits_shape and self.teeth[k].state == "fitted"
        ]

    def _with_updated_ties(self, mouth: Mouth) -> Mouth:
        # Start the next stage of tied teeth at the median of the others, with the mean cosine that all enamel shares.
        common = self._median_tissue(mouth)
        cosine = next(
            tooth.enamel.mean_cosine
            for tooth, start in zip(mouth.teeth, self.teeth, strict=True)
            if start.state == "fitted"
        )
        common = replace(common, enamel=similar_medium(common.enamel, cosine))
        tied = (replace(common, shape=tooth.shape) for tooth in mouth.teeth)
        chosen = (
            tooth if start.state == "fitted" else other
            for tooth, start, other in zip(mouth.teeth, self.teeth, tied, strict=True)
        )
        return replace(mouth, teeth=tuple(chosen))

    def _median_tissue(self, mouth: Mouth) -> Tissue:
        return median_tissue(self.teeth, mouth.teeth)


def _layered(ratio: tuple[float, float], tooth: Tissue, has_dentin: bool) -> Tissue:
    # The homogeneous tooth with its density split between its two media.
    return (
        tooth.with_values(
            {
                f"{part}.sigma": share * tooth.medium(part).sigma
                for part, share in zip(("enamel", "dentin"), ratio, strict=True)
            }
        )
        if has_dentin
        else tooth
    )
