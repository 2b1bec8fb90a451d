"""What the first channel's fit tells the others: a point to start from, the instrument's errors, and the mean cosine.

Shape and instrument are the same in all channels, and optics change slowly with the wavelength. So the other channels
need neither the search in the table nor the stages in similar media, and the first one's mean cosine is their prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from services.fit.coordinates.domain import HELD_G, similar_medium, to_dual
from services.fit.stages.channel_fit import ChannelFit
from services.transport.optics.parameters import Tissue

COSINE_DRIFT = 0.1
"""Standard deviation of the change of the enamel's mean cosine from channel to channel, in its coordinate atanh g: 0.05
at g = 0.7. An assumption: no source at hand gives it by wavelength."""


@dataclass(frozen=True)
class FirstChannel:
    """Outcome of the first channel's fit, as the other channels use it."""

    tissue: Tissue
    cosines: Mapping[str, tuple[float, float]]
    """Mean and standard deviation of the prior of each fitted mean cosine, in its coordinate, by medium."""
    errors: Mapping[str, float]
    """Estimates of the instrument's errors by name."""

    def start(self, lobes: int) -> Tissue:
        """Media to start from, without stains; as one lobe of the usual mean cosine where two are fitted later."""
        tissue = replace(self.tissue, stain=None)
        if lobes == 1:
            return tissue
        enamel, dentin = (similar_medium(medium, HELD_G) for medium in (tissue.enamel, tissue.dentin))
        return replace(tissue, enamel=enamel, dentin=dentin)


def first_channel(fit: ChannelFit[Tissue]) -> FirstChannel | None:
    """What the fit tells; None where it did not converge."""
    if not fit.solution.result.converged:
        return None
    domain, covariance = fit.domain, fit.uncertainty.covariance
    cosines = {}
    for k, coordinate in enumerate(domain.coordinates):
        if coordinate.kind == "cosine":
            part = coordinate.targets[0].rpartition(".")[0]
            mean = to_dual("cosine", fit.tissue.medium(part).mean_cosine)
            cosines[part] = mean, math.hypot(math.sqrt(max(float(covariance[k, k]), 0.0)), COSINE_DRIFT)
    return FirstChannel(fit.tissue, cosines, dict(domain.errors_at(fit.solution.x)))
