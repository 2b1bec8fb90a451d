"""Domains of the media of a single tooth."""

from __future__ import annotations

from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.coordinates.priors import WEAK, Priors


def shared_domain(priors: Priors = WEAK) -> Domain:
    """Domain of sigma and alpha, each shared by both media."""
    return Domain(tuple(_coordinate((f"enamel.{leaf}", f"dentin.{leaf}"), priors) for leaf in ("sigma", "alpha")))


def media_domain(parts: tuple[str, ...], leaves: tuple[str, ...], priors: Priors = WEAK) -> Domain:
    """Domain of parameters of each medium on its own."""
    return Domain(tuple(_coordinate((f"{part}.{leaf}",), priors) for part in parts for leaf in leaves))


def _coordinate(targets: tuple[str, ...], priors: Priors) -> Coordinate:
    # A coordinate shared by both media has a prior only where the priors of both are equal.
    prior, *others = (priors.get(target) for target in targets)
    return (
        Coordinate(targets) if prior is None or any(other != prior for other in others) else Coordinate(targets, *prior)
    )
