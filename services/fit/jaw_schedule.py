"""The joint fit of a jaw's channel: all teeth, gums and the wall's colour at once, light passing between them (teeth 2018, section 7).

=========  ==============================================================  =======  ===========================
stage      free                                                            media    ends
=========  ==============================================================  =======  ===========================
start.k    sigma, alpha of enamel and dentin of each tooth and of gums,    similar  two steps each; for each tooth
           the wall's reflectance, from several ratios of the media                 the least loss of its own
joint      the same                                                        similar  converged, or max_steps
exact      the same                                                        exact    converged, or max_steps
=========  ==============================================================  =======  ===========================

Before the first stage every tooth was looked at alone, as if homogeneous. Which of its two media is the denser one is asked with everything around it in
place: alone, gums and wall are missing, and what they reflect is taken for the tooth's own.

Teeth of which too little is seen, or whose own fit failed, have coordinates like all others, but with a Gaussian prior about the median of the front
teeth, taken anew before each stage. So what little is seen of them still counts, and where nothing is, they follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from services.fit.closing import Held
from services.fit.jaw_starts import ToothStart, typical
from services.fit.optics.domain import Coordinate, Domain, similar_tissue, to_dual
from services.fit.optics.parameters import Mouth, Tissue
from services.fit.optics.priors import WEAK, priors_of
from services.fit.passes import Near, StackProblem
from services.fit.schedule import EXACT_SAMPLES, SIMILAR_G, START_RATIOS, START_STEPS
from services.fit.stages import ChannelFit, Stages

TIED_SD = {"sigma": 0.2, "alpha": 0.15}
"""Spread of one mouth's teeth about their median, in the unbounded domain: 20 % of sigma, 35 % of 1 - alpha."""
GUMS_SD = {"sigma": 1.0, "alpha": 0.7}
"""About the start: gums were never measured alone."""
WALL_SD = 1.5
"""Of the logit of the wall's reflectance about its start."""


@dataclass(kw_only=True)
class JawSchedule(Stages[Mouth]):
    """The stages of one channel of a jaw."""

    start: Mouth
    teeth: Sequence[ToothStart]
    dentin: Sequence[bool]
    """Which teeth have dentin."""

    def run(self) -> ChannelFit[Mouth]:
        """Fit the channel."""
        samples = self.spec.samples_per_pixel
        options = self.in_similar_media(self.options(self.files.coarse))
        mouth = self._best_starts() if any(self.dentin) else self.start
        mouth, solution = self._iterate(self._problem(mouth, "joint", SIMILAR_G), options, 2 * samples)
        options = self.at_full_resolution()
        exact = self._problem(self._retied(mouth), "exact", None)
        mouth, solution = self._iterate(exact, options, self.fewer(min(solution.samples, EXACT_SAMPLES * samples)))
        return self._finish(replace(exact, base=mouth, stage="final"), solution)

    def _problem(self, mouth: Mouth, stage: str, image_g: float | None) -> StackProblem[Mouth]:
        domain = self._domain(mouth)
        near = nearby([start.fdi for start in self.teeth], domain)
        return StackProblem(self.passes, domain, mouth, stage, jacobian_g=SIMILAR_G, image_g=image_g, near=near)

    def _best_starts(self) -> Mouth:
        # Every ratio for all teeth at once; their losses are compared tooth by tooth, with the same seeds.
        ends = []
        for k, ratio in enumerate(START_RATIOS):
            start = replace(self.start, teeth=tuple(map(partial(_layered, ratio), self.start.teeth, self.dentin)))
            ends.append(self._iterate(self._problem(start, f"start.{k}", SIMILAR_G), self.short(START_STEPS), self.spec.samples_per_pixel)[0])
        samples = min(4 * self.spec.samples_per_pixel, self.spec.max_samples_per_pixel)

        def compute() -> list[list[float]]:
            found = [self._evaluate("starts", similar_tissue(end, SIMILAR_G), samples, self.files.coarse) for end in ends]
            whole = [each.fitted.product for each in found]
            return [[each.parts[k][0].product if k in each.parts else total for each, total in zip(found, whole, strict=True)] for k in range(len(self.teeth))]

        self.pause()
        losses, _ = self.journal.once(f"{self.scope}/starts", compute)
        best = [ends[int(np.argmin(own))].teeth[k] for k, own in enumerate(losses)]
        return replace(ends[int(np.argmin(np.sum(losses, axis=0)))], teeth=tuple(best))

    @property
    def media(self) -> tuple[str, ...]:
        """See Stages."""
        teeth = [f"{k}.{part}" for k, has_dentin in enumerate(self.dentin) for part in (("enamel", "dentin") if has_dentin else ("enamel",))]
        return (*teeth, *(() if self.start.gums is None else ("gums",)))

    @property
    def things(self) -> int:
        """See Stages."""
        return len(self.teeth)

    def _held(self, domain: Domain) -> Held:  # noqa: ARG002 - a jaw's coordinates hold every mean cosine
        # Media of one tissue are wrong alike: 29 of them, each on its own, would cost more than the fit.
        kinds = {"enamel": WEAK["enamel.g1"], "dentin": WEAK["dentin.g1"], "gums": WEAK["enamel.g1"]}
        alike = {tuple(part for part in self.media if part.rpartition(".")[2] == kind): prior for kind, prior in kinds.items()}
        return {parts: prior for parts, prior in alike.items() if parts}

    def _others(self, tissue: Mouth) -> dict[str, float]:
        return {} if tissue.reflectance is None else {"cavity.reflectance": tissue.reflectance}

    def _domain(self, mouth: Mouth) -> Domain:
        common = Mouth((self._typical(mouth),))
        coordinates = []
        for part in self.media:
            tooth, _, medium = part.rpartition(".")
            for kind in ("sigma", "alpha"):
                name = f"{part}.{kind}"
                if part == "gums":
                    coordinates.append(Coordinate((name,), to_dual(kind, self.start.value(name)), GUMS_SD[kind]))
                elif self.teeth[int(tooth)].state != "fitted":
                    coordinates.append(Coordinate((name,), to_dual(kind, common.value(f"0.{medium}.{kind}")), TIED_SD[kind]))
                else:
                    prior = priors_of(self.spec.prior).get(f"{medium}.{kind}")
                    coordinates.append(Coordinate((name,), *prior) if prior else Coordinate((name,)))
        if mouth.reflectance is not None:
            assert self.start.reflectance is not None
            coordinates.append(Coordinate(("cavity.reflectance",), to_dual("reflectance", self.start.reflectance), WALL_SD))
        return Domain(tuple(coordinates))

    def _retied(self, mouth: Mouth) -> Mouth:
        # Teeth that are tied start the next stage where the others now are.
        common = self._typical(mouth)
        return replace(mouth, teeth=tuple(tooth if start.state == "fitted" else common for tooth, start in zip(mouth.teeth, self.teeth, strict=True)))

    def _typical(self, mouth: Mouth) -> Tissue:
        return typical(self.teeth, mouth.teeth)


def _layered(ratio: tuple[float, float], tooth: Tissue, has_dentin: bool) -> Tissue:
    # The homogeneous tooth with its density shared out to its two media.
    return (
        tooth.with_values({f"{part}.sigma": share * tooth.medium(part).sigma for part, share in zip(("enamel", "dentin"), ratio, strict=True)})
        if has_dentin
        else tooth
    )


def nearby(fdi: Sequence[int], domain: Domain) -> Near:
    """For each tooth the coordinates of itself, its two neighbours along the arch, gums and wall."""
    order = sorted(range(len(fdi)), key=lambda k: arch_place(fdi[k]))
    near = []
    for k in range(len(fdi)):
        place = order.index(k)
        teeth = {str(other) for other in order[max(place - 1, 0) : place + 2]} | {"gums", "cavity"}
        near.append(tuple(n for n, name in enumerate(domain.parameters) if name.partition(".")[0] in teeth))
    return tuple(near)


def arch_place(fdi: int) -> int:
    """Signed place along the arch from the midline: negative for the patient's right (quadrants 1, 4), positive for the left (2, 3)."""
    quadrant, place = divmod(fdi, 10)
    return -place if quadrant in {1, 4} else place
