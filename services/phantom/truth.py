"""A fit of a virtual tooth beside the media that it was rendered with: what a laboratory compares."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from services.core.errors import CorruptStoreError

TRUTH = "truth.json"
"""File of a phantom with its true media."""
TISSUES = ("enamel", "dentin")


@dataclass(frozen=True)
class ComparedScattering:
    """Reduced scattering of one tissue in one channel, 1/mm."""

    tissue: str
    channel: str
    found: float
    se: float | None
    """One standard error; None where it was not fitted."""
    simulated: float
    """The value with which the photographs were rendered."""

    def as_json(self) -> dict[str, Any]:
        """All values by name."""
        return asdict(self) | {"unit": "1/mm"}


def compared_scattering(job: Path) -> tuple[ComparedScattering, ...]:
    """Reduced scattering of a job's fit beside that of its virtual mouth, a line a tissue and channel.

    Raises:
        CorruptStoreError: one of the two files cannot be read.
    """
    truth, fitted = (_read(path) for path in (job / "phantom" / TRUTH, job / "parameters.json"))
    found = []
    for tissue in TISSUES:
        for channel, table in fitted.items():
            name = f"{tissue}.sigma_s_reduced"
            known = truth["channels"].get(channel, {}).get(tissue)
            if known is not None and name in table:
                one = table[name]
                found.append(ComparedScattering(tissue, channel, one["value"], one["se"], known["sigma_s_reduced"]))
    return tuple(found)


def scattering_lines(compared: tuple[ComparedScattering, ...]) -> list[str]:
    """The comparison as lines of text, with a head."""
    head = "reduced scattering σs', 1/mm   found ± standard error   simulated"
    rows = [
        f"  {one.tissue:7s} {one.channel:19s}  {one.found:.3f} {'not fitted' if one.se is None else f'± {one.se:.3f}'}"
        for one in compared
    ]
    return [head, *(f"{row:55s} {one.simulated:.3f}" for row, one in zip(rows, compared, strict=True))]


def _read(path: Path) -> dict[str, Any]:
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise CorruptStoreError(
            f"{path} cannot be read ({problem}); run the demonstration in a new folder."
        ) from problem
    return value
