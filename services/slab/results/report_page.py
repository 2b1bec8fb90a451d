"""A slab's report: one HTML file with errors, coefficients, phase functions and images, without any outside
reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.pages.cells import cell, gradient
from services.core.pages.page import page_template
from services.core.pages.pictures import DIVERGING, data_uri, enlarge, signed_map, tone_map, white_level
from services.core.results import Estimate, Figure, Verdict
from services.core.store import write_atomic
from services.core.verdict import mean_figure, percent
from services.slab.results.chart import phase_chart
from services.slab.results.result import Quantity, SlabFit, SlabReport
from services.slab.results.stored import Images

LABELS = {
    "sigma_t": "extinction σt",
    "sigma_s": "scattering σs",
    "sigma_a": "absorption σa",
    "sigma_s_reduced": "reduced scattering σs′",
    "g": "mean cosine g",
    "index": "index of refraction",
}
ATOM_LABELS = {"volume_fraction": "volume of all spheres", "mean_radius": "mean radius, by volume"}
RESIDUAL_OF_WHITE = 0.1
"""Share of an image's white at which the residual's colours end."""
MAX_PICTURES = 18
"""Largest number of images shown for each wavelength, those of Gkioulekas et al. (2013); the held-out ones come
first."""


def write_report(
    path: Path,
    report: SlabReport,
    verdict: Verdict,
    images: Mapping[float, Images],
    provenance: Mapping[str, str],
) -> None:
    """Write the page.

    Args:
        images: by wavelength, nm.
        provenance: labels and texts on the origin of the result.
    """
    template = page_template(Path(__file__).parent / "report.html.j2")
    page = template.render(
        verdict=verdict,
        notes=_notes(report),
        held_out=_errors(report, "held_out_error"),
        fitted=_errors(report, "fit_error"),
        seconds=f"{sum(fit.core_seconds for fit in report.fits):.0f}",
        paths=f"{sum(fit.paths for fit in report.fits) / 1e6:.1f}",
        wavelengths=[f"{fit.wavelength_nm:g} nm" for fit in report.fits],
        parameters=[_row(report, name) for name in LABELS],
        atoms=[(f"{fit.wavelength_nm:g} nm", fit.dictionary, _atoms(fit)) for fit in report.fits if fit.atoms],
        phases=[_phase(fit) for fit in report.fits],
        pictures=[
            (f"{fit.wavelength_nm:g} nm", _pictures(images[fit.wavelength_nm]), len(images[fit.wavelength_nm].names))
            for fit in report.fits
        ],
        residual_bar=gradient(DIVERGING),
        residual_limit=f"{100 * RESIDUAL_OF_WHITE:g} %",
        provenance=list(provenance.items()),
    )
    write_atomic(path, page.encode())


def _notes(report: SlabReport) -> list[str]:
    # Write a note that holds for all wavelengths once.
    every = [note for note in report.fits[0].notes if all(note in fit.notes for fit in report.fits)]
    return every + [
        f"{fit.wavelength_nm:g} nm: {note}" for fit in report.fits for note in fit.notes if note not in every
    ]


def _errors(report: SlabReport, name: str) -> dict[str, Any] | None:
    errors, ses = (
        {f"{fit.wavelength_nm:g} nm": found for fit in report.fits if (found := getattr(fit.errors, one)) is not None}
        for one in (name, f"{name}_se")
    )
    if not errors:
        return None
    mean = mean_figure(errors, ses)
    each = [(wavelength, percent(Figure(value=error, se=ses.get(wavelength)))) for wavelength, error in errors.items()]
    each = each if len(each) > 1 else []
    return {"mean": percent(mean), "each": each}


def _row(report: SlabReport, name: str) -> dict[str, Any]:
    quantities: list[Quantity] = [getattr(fit.parameters, name) for fit in report.fits]
    # An index that was given has no standard error.
    cells = [
        cell(Estimate(value=one.value, se=one.se or None, unit=one.unit, determined=one.determined))
        for one in quantities
    ]
    unit = "given" if not any(one.se for one in quantities) else "" if quantities[0].unit == "1" else "per mm"
    return {"label": LABELS[name], "name": name, "cells": cells, "unit": unit}


def _atoms(fit: SlabFit) -> list[dict[str, Any]]:
    """Rows of the sums over the dictionary's atoms, and of those atoms that are present."""
    present = {name: one for name, one in fit.atoms.items() if one.value > 0}
    return [
        {
            "name": ATOM_LABELS.get(name, _atom_label(name)),
            "cell": cell(Estimate(value=one.value, se=one.se, unit=one.unit, determined=one.determined)),
            "unit": {"1/mm": "per mm", "um": "µm"}.get(one.unit, ""),
        }
        for name, one in present.items()
    ]


def _atom_label(name: str) -> str:
    """Readable label of an atom such as ``atoms.radius=0.250um``."""
    what, _, atom = name.partition(".")
    label = atom.replace("=", " ").removesuffix("um") + (" µm" if atom.endswith("um") else "")
    return f"{'volume' if what == 'volumes' else 'σs'} of {label}"


def _phase(fit: SlabFit) -> tuple[str, str, str]:
    name = f"{fit.wavelength_nm:g} nm"
    bands = ", ".join(f"{low:.1f} to {high:.1f}" for low, high in fit.phase.undetermined_bands_deg())
    return name, phase_chart(f"Phase function at {name}", fit.phase), bands


def _pictures(images: Images) -> list[dict[str, Any]]:
    order = np.argsort(~images.held_out, kind="stable")[:MAX_PICTURES]
    return [_picture(images, int(k)) for k in order]


def _picture(images: Images, k: int) -> dict[str, Any]:
    measured, predicted = images.measured[k], images.predicted[k]
    known = np.isfinite(measured)
    white = white_level(measured, known)
    residual = np.where(known, predicted - measured, 0.0)
    shown = [
        ("measured", tone_map(measured, white)),
        ("predicted", tone_map(predicted, white)),
        ("residual", signed_map(residual, RESIDUAL_OF_WHITE * white, known)),
    ]
    return {
        "images": [(name, data_uri(enlarge(image))) for name, image in shown],
        "name": images.names[k],
        "held_out": bool(images.held_out[k]),
        "white": f"{white:.3g}",
        "difference": _difference(residual, measured, known),
    }


def _difference(residual: NDArray[np.float64], measured: NDArray[np.float64], known: NDArray[np.bool_]) -> str:
    energy = float(np.sqrt((measured[known] ** 2).sum()))
    share = float(np.sqrt((residual[known] ** 2).sum()))
    return percent(Figure(value=share / energy, se=None)) if energy > 0 else ""
