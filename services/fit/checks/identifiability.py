"""Sentences on which quantities of a tooth a capture determines and which it does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from services.core.results import Correlation, Estimate
from services.fit.solve.covariance import Uncertainty

NOT_EXPLAINED = "The fit does not explain these images yet, so what this capture tells of the tooth is not known."
PARTLY_EXPLAINED = (
    "The model leaves out part of these images, so the coefficients may be farther off than their standard errors and"
    " what this capture tells of the tooth is not known."
)
QUANTITIES = {"sigma_s_reduced": "scattering", "sigma_a": "absorption"}
COORDINATES = {"sigma": ("scattering", 1), "alpha": ("absorption", -1)}
"""Quantity that changes with a coordinate, and the sign of the change."""
MAX_RELATIVE_SE = 0.5
"""Largest relative standard error of a quantity that counts as determined in these sentences."""
EXCHANGEABLE = 0.9
"""Absolute correlation from which two quantities count as exchangeable."""


def correlation(uncertainty: Uncertainty) -> Correlation:
    """Correlation of the errors of the tissue's coordinates, without the remaining step to the minimum. A coordinate
    without error is uncorrelated with the others.
    """
    count = uncertainty.domain.tissue_count
    covariance = (uncertainty.covariance if uncertainty.sandwich is None else uncertainty.sandwich.covariance)[
        :count, :count
    ]
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(errors > 0, errors, np.inf)
    matrix = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    return Correlation(
        names=uncertainty.domain.names[:count], matrix=tuple(tuple(float(v) for v in row) for row in matrix)
    )


def determined_sentences(tables: Mapping[str, Mapping[str, Estimate]], correlations: Mapping[str, Correlation]) -> str:
    """One or more sentences: the determined quantities with unit and standard error, the others with their limits, and
    the pair of quantities that is hardest to distinguish.
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for channel, table in tables.items():
        groups.setdefault(tuple(name for name in _quantities(table) if _is_determined(table[name])), []).append(channel)
    sentences = [
        _sentence(determined, channels, tables, alone=len(tables) == 1) for determined, channels in groups.items()
    ]
    exchangeable = _exchangeable_pair(correlations)
    return " ".join(sentences + ([exchangeable] if exchangeable else []))


def quantity_in_words(name: str) -> str:
    """Name of a quantity in words: ``enamel.sigma_a`` becomes *enamel absorption*."""
    part, _, leaf = name.rpartition(".")
    return f"{part} {QUANTITIES[leaf]}"


def _quantities(table: Mapping[str, Estimate]) -> list[str]:
    return [f"{part}.{leaf}" for part in ("enamel", "dentin") for leaf in QUANTITIES if f"{part}.{leaf}" in table]


def _is_determined(estimate: Estimate) -> bool:
    return estimate.determined and estimate.se is not None and estimate.se <= MAX_RELATIVE_SE * abs(estimate.value)


def _sentence(
    determined: Sequence[str], channels: Sequence[str], tables: Mapping[str, Mapping[str, Estimate]], *, alone: bool
) -> str:
    def values(name: str, what: str) -> str:
        found = [(channel, tables[channel][name]) for channel in channels]
        texts = [
            ("" if len(found) == 1 else f"{channel} ") + (_value(e) if what == "value" else _limits(e))
            for channel, e in found
        ]
        return ", ".join(texts)

    opening = "This capture" if alone else f"In {_listed(channels)} this capture"
    undetermined = [name for name in _quantities(tables[channels[0]]) if name not in determined]
    determined_text = _listed([f"{quantity_in_words(name)} ({values(name, 'value')})" for name in determined])
    undetermined_text = _listed(
        [f"{quantity_in_words(name)} ({values(name, 'limits')} fits)" for name in undetermined], "or"
    )
    if not determined:
        return f"{opening} does not tell {undetermined_text}."
    return f"{opening} tells {determined_text}" + (f", but not {undetermined_text}." if undetermined else ".")


def _value(estimate: Estimate) -> str:
    assert estimate.se is not None
    digits = int(np.clip(1 - np.floor(np.log10(estimate.se)), 0, 6)) if estimate.se > 0 else 4
    return f"{estimate.value:.{digits}f} ± {estimate.se:.{digits}f} per mm"


def _limits(estimate: Estimate) -> str:
    # 95 % limits, at least 0, because none of these quantities is negative.
    if estimate.se is None or not np.isfinite(estimate.se):
        return "anything"
    low, high = max(estimate.value - 2 * estimate.se, 0.0), estimate.value + 2 * estimate.se
    return f"anything from {low:.2g} to {high:.2g} per mm" if low > 0 else f"anything up to {high:.2g} per mm"


def _exchangeable_pair(correlations: Mapping[str, Correlation]) -> str:
    # The pair with the largest correlation of errors, over all channels.
    found: list[tuple[float, str]] = []
    for one in correlations.values():
        for a, b in combinations(range(len(one.names)), 2):
            (part_a, _, leaf_a), (part_b, _, leaf_b) = one.names[a].rpartition("."), one.names[b].rpartition(".")
            if leaf_a in COORDINATES and leaf_b in COORDINATES and abs(one.matrix[a][b]) >= EXCHANGEABLE:
                (word_a, sign_a), (word_b, sign_b) = COORDINATES[leaf_a], COORDINATES[leaf_b]
                less = one.matrix[a][b] * sign_a * sign_b < 0
                found.append(
                    (
                        abs(one.matrix[a][b]),
                        (
                            f"More {part_a} {word_a} with {'less' if less else 'more'} {part_b} {word_b} would look"
                            " almost the same."
                        ),
                    )
                )
    return max(found)[1] if found else ""


def _listed(items: Sequence[str], last: str = "and") -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {last} {items[-1]}" if items else ""
