"""The joint fit of a jaw's channel: all teeth, gums and the wall's colour at once, light passing between them (teeth 2018, section 7).

=========  ==============================================================  =======  ===========================
stage      free                                                            media    ends
=========  ==============================================================  =======  ===========================
joint      sigma, alpha of enamel and dentin of each tooth and of gums,    similar  converged, or max_steps
           the wall's reflectance
exact      the same                                                        exact    converged, or max_steps
=========  ==============================================================  =======  ===========================

Teeth of which too little is seen, or whose own fit failed, have coordinates like all others, but with a Gaussian prior about the median of the front
teeth, taken anew before each stage. So what little is seen of them still counts, and where nothing is, they follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from services.core.errors import SettingsError
from services.fit.jaw_starts import ToothStart, typical
from services.fit.optics.domain import Coordinate, Domain, to_dual
from services.fit.optics.parameters import Mouth, Tissue
from services.fit.passes import Near, StackProblem
from services.fit.schedule import EXACT_SAMPLES, PRIORS, SIMILAR_G
from services.fit.solve.gauss_newton import Options
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
        """Fit the channel.

        Raises:
            SettingsError: more than one lobe was asked for.
        """
        spec, samples = self.spec, self.spec.samples_per_pixel
        if spec.lobes != 1:
            raise SettingsError("A jaw is fitted with one lobe per medium; set lobes to 1, or fit its teeth one by one with kind 'tooth'.")
        options = Options(max_steps=spec.max_steps, max_samples=spec.max_samples_per_pixel, tolerance=self.tolerance, parts=len(self.teeth))
        mouth, near = self.start, nearby([start.fdi for start in self.teeth], self._domain(self.start))
        similar = StackProblem(self.passes, self._domain(mouth), mouth, "joint", jacobian_g=SIMILAR_G, image_g=SIMILAR_G, near=near)
        mouth, solution = self._iterate(similar, options, 2 * samples)
        mouth = self._retied(mouth)
        exact = StackProblem(self.passes, self._domain(mouth), mouth, "exact", jacobian_g=SIMILAR_G, near=near)
        mouth, solution = self._iterate(exact, options, min(solution.samples, EXACT_SAMPLES * samples))
        return self._finish(replace(exact, base=mouth, stage="final"), solution)

    @property
    def media(self) -> tuple[str, ...]:
        """See Stages."""
        teeth = [f"{k}.{part}" for k, has_dentin in enumerate(self.dentin) for part in (("enamel", "dentin") if has_dentin else ("enamel",))]
        return (*teeth, *(() if self.start.gums is None else ("gums",)))

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
                    coordinates.append(Coordinate((name,), *PRIORS[kind]) if kind in PRIORS else Coordinate((name,)))
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
