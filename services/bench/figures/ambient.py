"""Bias of a fit's parameters by ambient light from all around, which the model of a capture does not contain (teeth
2018, section 7).
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.bench.figures.cases import Case
from services.bench.figures.drawings import Drawn
from services.bench.figures.figure_cases import FigureCases
from services.bench.figures.fitted import Fitted
from services.bench.figures.surroundings import render_under
from services.bench.fits.tooth_capture import tissue_of
from services.core.files.meshes import read_mesh
from services.core.records import FolderCapture
from services.core.results import FitReport
from services.core.store import read_record
from services.phantom.surface import ENAMEL_ROUGHNESS

CHANNEL = "green"
AMBIENT_SAMPLES = 256
QUANTITIES = tuple(
    f"{part}.{leaf}" for part in ("enamel", "dentin") for leaf in ("sigma_s_reduced", "absorption_share")
)
"""Quantities that are compared with the truth: reduced scattering, per mm, and 1 - alpha' of either tissue."""

Row = dict[str, Any]


def under_ambient_light(cases: FigureCases) -> Drawn:
    """Draw the results of fits of one view with constant light from all around added to its photographs."""
    rows = ambient_rows(cases)
    return Drawn(
        plot(rows),
        "A procedural incisor of known dentin from one side, with constant light from all around added to every"
        f" photograph, its mirror image included. {sentence(rows)}",
    )


def ambient_rows(cases: FigureCases) -> list[Row]:
    """Fit the photographs with each strength of ambient light, first without any.

    Returns:
        Rows of ``fraction`` (strength as a fraction of the mean radiance of the fitted photographs), ``fit_error``,
        ``held_out_error``, and for each quantity its ``value``, ``se`` and ``truth``.
    """
    case = cases.single_view
    source = case.capture.rendered(cases.work)
    media = json.loads((source / "truth.json").read_text())["channels"][CHANNEL]
    rows = []
    for fraction in cases.effort.ambient:
        folder = (
            case.fitted_with(cases.work, _added(source, case, fraction), f"-ambient-{fraction:g}")
            if fraction
            else case.fitted(cases.work)
        )
        rows.append({"fraction": fraction} | described(Fitted(folder).report, media))
    return rows


def _added(source: Path, case: Case, fraction: float) -> dict[str, NDArray[np.float64]]:
    # Return the added radiance (H, W) by camera, rendered with the true media. The render is kept beside the capture,
    # because it serves every strength.
    cache = source.with_name(f"{source.name}-around.npz")
    description = read_record(source / "capture.json", FolderCapture)
    if not cache.is_file():
        truth = json.loads((source / "truth.json").read_text())
        media = truth["channels"][CHANNEL]
        tissue = tissue_of({f"{part}.{leaf}": value for part in media for leaf, value in media[part].items()})
        (tooth,) = (source / "teeth").iterdir()
        surfaces = {path.stem: read_mesh(path) for path in sorted(tooth.glob("*.ply"))}
        options = {
            "samples": AMBIENT_SAMPLES,
            "boundary": truth["boundary"],
            "ior": truth["ior"],
            "roughness": ENAMEL_ROUGHNESS,
        }
        constant = {"type": "constant", "radiance": 1.0}
        around = {
            c.name: render_under(constant, surfaces, tissue, c, **options)
            for c in description.cameras
            if c.name in case.cameras
        }
        np.savez(cache, allow_pickle=False, **around)
    channel = description.channels.index(CHANNEL)
    fitted = [
        np.load(source / image.file)[..., channel]
        for image in description.images
        if case.is_fitted(image.camera, image.light)
    ]
    mean = float(np.concatenate([image[image > 0] for image in fitted]).mean())
    with np.load(cache) as stored:
        # Keep the pixels of the tooth alone: those beside it show the surroundings, which are masked in a capture.
        on_tooth = {
            camera: np.where(_tooth_pixels(source, description, camera), stored[camera], 0.0) for camera in stored.files
        }
    return {camera: fraction * mean * image / image[image > 0].mean() for camera, image in on_tooth.items()}


def _tooth_pixels(source: Path, description: FolderCapture, camera: str) -> NDArray[np.bool_]:
    is_lit = [np.load(source / image.file).max(axis=-1) > 0 for image in description.images if image.camera == camera]
    return np.asarray(np.any(is_lit, axis=0))


def described(report: FitReport, media: Mapping[str, Mapping[str, float]]) -> Row:
    """Return a fit's estimate of each quantity, with the truth."""
    row: Row = {"fit_error": report.fit_error[CHANNEL], "held_out_error": report.held_out_error[CHANNEL]}
    for quantity in QUANTITIES:
        part, leaf = quantity.split(".")
        if leaf == "absorption_share":
            found, true = report.parameters[CHANNEL][f"{part}.alpha_reduced"], media[part]["alpha_reduced"]
            row[quantity] = {"value": 1 - found.value, "se": found.se, "truth": 1 - true}
        else:
            found = report.parameters[CHANNEL][quantity]
            row[quantity] = {"value": found.value, "se": found.se, "truth": media[part][leaf]}
    return row


def found_over_true(row: Row, quantity: str) -> str:
    """Return the ratio of a quantity to its truth, with its standard error, as text."""
    point = row[quantity]
    ratio = f"{point['value'] / point['truth']:.2f}"
    return ratio if point["se"] is None else f"{ratio} ± {point['se'] / point['truth']:.2f}"


def sentence(rows: Sequence[Row]) -> str:
    """Return a sentence with the ratios of all fits' estimates to the truth."""
    parts = []
    for row in rows:
        found = ", ".join(found_over_true(row, quantity) for quantity in QUANTITIES)
        strength = f"with {100 * row['fraction']:.0f} % of the mean radiance" if row["fraction"] else "without it"
        parts.append(f"{strength} {found}, held-out error {100 * row['held_out_error']:.1f} %")
    return f"Found over true, σs' and 1 − α' of enamel and then of dentin: {'; '.join(parts)}."


def table(rows: Sequence[Row]) -> str:
    """Return a Markdown table of the estimates of all fits, with standard errors and truth."""
    head = (
        "| ambient light | σs' enamel, per mm | 1 − α' enamel | σs' dentin, per mm | 1 − α' dentin | fit | held out"
        " |\n|---|---|---|---|---|---|---|\n"
    )
    lines = ["| truth | " + " | ".join(f"{rows[0][quantity]['truth']:.3g}" for quantity in QUANTITIES) + " | | |"]
    for row in rows:
        found = " | ".join(
            f"{row[q]['value']:.3g}" + ("" if row[q]["se"] is None else f" ± {row[q]['se']:.1g}") for q in QUANTITIES
        )
        lines.append(
            f"| {100 * row['fraction']:.0f} % | {found} | {100 * row['fit_error']:.1f} % |"
            f" {100 * row['held_out_error']:.1f} % |"
        )
    return head + "\n".join(lines) + "\n"


def plot(rows: Sequence[Row]) -> NDArray[np.uint8]:
    """Draw the ratios of estimates to truth, with standard errors, against the strength of the ambient light."""
    from PIL import Image

    from services.bench.plots import grid, write_png

    figure, axes = grid(2)
    for one, leaf in zip(axes, ("sigma_s_reduced", "absorption_share"), strict=True):
        for part in ("enamel", "dentin"):
            found = [row[f"{part}.{leaf}"] for row in rows]
            values, errors = (
                np.array([(point[key] or 0.0) / point["truth"] for point in found]) for key in ("value", "se")
            )
            one.errorbar([100 * row["fraction"] for row in rows], values, errors, marker="o", capsize=3, label=part)
        one.axhline(1.0, color="0.6", linewidth=1)
        one.set(
            title="σs'" if leaf == "sigma_s_reduced" else "1 − α'",
            xlabel="ambient light, % of the mean radiance",
            ylabel="found over true",
        )
        one.legend()
    stream = io.BytesIO()
    write_png(figure, stream)
    return np.asarray(Image.open(stream).convert("RGB"))
