"""Report of a fit as one self-contained HTML file: the measured parameters, their uncertainty, and where the
fit fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.curves import Series, log_chart
from services.assets.instrument_tables import instrument_tables, source_tables
from services.assets.surface_maps import stain_maps, thickness_maps
from services.core.pages.cells import cell, gradient
from services.core.pages.page import page_template
from services.core.pages.pictures import (
    DIVERGING,
    RESIDUAL_OF_WHITE,
    SEQUENTIAL,
    Picture,
    data_uri,
    enlarge,
    signed_map,
    tone_map,
    white_level,
)
from services.core.results import Correlation, Estimate, Figure, FitReport, ToothReport
from services.core.store import write_atomic
from services.core.verdict import mean_figure, percent, verdict_of
from services.transport.thickness import ThicknessMap

PART_LABELS = {
    "enamel": "Enamel",
    "dentin": "Dentin",
    "body": "Body",
    "core": "Core",
    "shape": "Dentin shape",
    "gums": "Gums",
    "cavity": "Wall of the mouth",
}
LEAF_LABELS = {
    "sigma": "extinction σ",
    "alpha": "albedo α",
    "absorbed": "absorbed share 1 − α",
    "beta": "first lobe's weight β",
    "g1": "mean cosine g₁",
    "g2": "mean cosine g₂",
    "g": "mean cosine g",
    "sigma_s_reduced": "reduced scattering σs′",
    "sigma_a": "absorption σa",
    "alpha_reduced": "reduced albedo α′",
    "mean_cosine": "mean cosine g",
    "reflectance": "diffuse reflectance",
}
SHAPE_LABELS = ("buccal", "proximal", "occlusal")
LEADING = ("sigma_s_reduced", "alpha_reduced", "sigma_a")
"""Quantities that images determine best and that lead the report."""
THIN_CAVEAT = (
    "The surface was modelled as a thin layer that does not bend light (teeth 2018). Its internal diffuse reflectance"
    " is 0.111 where a real surface of index 1.631 has 0.666, so fitted absorption 1 − α comes out 3 to 6 times too"
    " large (half space: 3 at 1 − α′ = 0.1, 5 at 0.01, limit 7) and is not comparable with the literature."
    " With boundary = rough it is."
)


@dataclass(frozen=True)
class ReportPictures:
    """Pictures of the report."""

    channels: tuple[str, ...]
    pictures: tuple[Picture, ...]
    """Photographs and renders; one fitted and one held-out light per camera suffice."""
    thickness: ThicknessMap | None = None
    """Thickness of the enamel as one camera sees it."""
    camera: str = ""
    """Name of the camera of the thickness map and of the stains."""
    stains: NDArray[np.floating] | None = None
    """Transmittance of the stains (H, W, C), NaN off the tooth; see ``stains.stain_images``."""
    stain_errors: NDArray[np.floating] | None = None
    """Standard error of that (H, W, C), NaN also in channels where it is not known; None where it is known in none."""
    stained: tuple[str, ...] = ()
    """The C channels that have stains."""


def write_report(
    path: Path,
    report: FitReport,
    pictures: ReportPictures,
    history: list[dict[str, Any]],
    context: dict[str, Any],
    *,
    with_photographs: bool = True,
) -> None:
    """Write the report as one HTML file without any outside reference.

    Args:
        path: receives the report.
        report: the fit's report.
        pictures: the pictures to show.
        history: one entry per step with ``step``, ``loss`` and, where known, ``held_out_error``, ``held_out_se``,
            ``stage`` and ``channel``.
        context: ``title``, ``boundary``, ``ior``, ``lead`` (address of the picture to begin with), ``provenance``
            (a dict of label -> text) and ``appearance`` (see ``appearance_sections``); all optional.
        with_photographs: whether photographs and residuals are shown beside the renders.
    """
    verdict = verdict_of(report)
    template = page_template(Path(__file__).parent / "report.html.j2")
    boundary = context.get("boundary", "")
    page = template.render(
        title=context.get("title", "Fit"),
        verdict=verdict,
        headline=verdict.headline,
        error=percent(verdict.error),
        advice=report.advice,
        notes=report.notes,
        instrument_told=report.instrument_told,
        instrument=instrument_tables(report),
        sources=source_tables(report, _is_leading, _source_label),
        told=report.told,
        next_capture=report.next_capture,
        correlations=_correlations(report.correlations),
        held_out=_error_rows(report.held_out_error, report.held_out_error_se),
        fitted=_error_rows(report.fit_error, report.fit_error_se),
        mean_thickness="" if report.enamel_thickness is None else _spread(report.enamel_thickness),
        steps=report.steps,
        seconds=_duration(report.seconds),
        lead=context.get("lead", ""),
        with_photographs=with_photographs,
        triptychs=[
            _triptych(picture, pictures.channels, with_photographs=with_photographs)
            for picture in sorted(pictures.pictures, key=lambda p: (p.camera, p.held_out))
        ],
        residual_bar=gradient(DIVERGING),
        residual_limit=f"{100 * RESIDUAL_OF_WHITE:g} %",
        charts=_charts(history),
        stages=_stages(history),
        channels=list(report.parameters),
        parameters=_parameter_rows(report.parameters),
        teeth=_tooth_rows(report.teeth),
        tooth_sentences=[
            (fdi, [sentence for sentence in (tooth.sentence, tooth.told) if sentence])
            for fdi, tooth in report.teeth.items()
        ],
        thickness=thickness_maps(
            pictures.thickness, "" if pictures.thickness is None else _spread(pictures.thickness.mean), pictures.camera
        ),
        thickness_bar=gradient(SEQUENTIAL),
        stains=stain_maps(pictures.stains, pictures.stain_errors, pictures.stained, pictures.camera),
        caveat=THIN_CAVEAT if boundary == "thin" else "",
        provenance=_provenance(boundary, context),
        appearance=context.get("appearance"),
    )
    write_atomic(path, page.encode())


def _error_rows(errors: dict[str, float], ses: dict[str, float]) -> dict[str, Any] | None:
    if not errors:
        return None
    channels = [(channel, percent(Figure(value=error, se=ses.get(channel)))) for channel, error in errors.items()]
    return {"mean": percent(mean_figure(errors, ses)), "channels": channels}


def _spread(estimate: Estimate) -> str:
    if estimate.se is None:
        return f"{estimate.value:.2f} {estimate.unit}"
    return f"{estimate.value:.2f} ± {estimate.se:.2f} {estimate.unit}"


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.1f} %" if abs(fraction) >= 0.01 else f"{100 * fraction:.2f} %"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _triptych(picture: Picture, channels: tuple[str, ...], *, with_photographs: bool) -> dict[str, Any]:
    # Use one tone curve for photograph and render; its white comes from the photograph alone, so that a wrong render
    # stays visible.
    white = white_level(picture.photo, picture.valid)
    residual = picture.residual
    compared = picture.valid[..., None] & np.isfinite(picture.photo)
    scale = float(np.linalg.norm(np.where(compared, np.asarray(picture.photo, dtype=np.float64), 0.0)))
    difference = float(np.linalg.norm(np.where(compared, residual, 0.0)))
    several = len(channels) > 1 and picture.photo.shape[-1] == len(channels)
    return {
        "camera": picture.camera,
        "light": picture.light,
        "held_out": picture.held_out,
        "white": f"{white:.3g}",
        "difference": _percent(difference / scale) if scale > 0 else "",
        "share": _percent(float(picture.valid.mean())),
        "images": _shown(picture, with_photographs=with_photographs),
        "channels": [
            (channel, _shown(_of_channel(picture, k), with_photographs=with_photographs))
            for k, channel in enumerate(channels if several else ())
        ],
        "width": picture.photo.shape[1],
        "height": picture.photo.shape[0],
    }


def _of_channel(picture: Picture, k: int) -> Picture:
    return replace(picture, photo=picture.photo[..., k : k + 1], render=picture.render[..., k : k + 1])


def _shown(picture: Picture, *, with_photographs: bool) -> list[tuple[str, str]]:
    # A render and its residual give the photograph, so both are left out together.
    white = white_level(picture.photo, picture.valid)
    shown = {"photo": tone_map(picture.photo, white)} if with_photographs else {}
    shown["render"] = tone_map(picture.render, white)
    if with_photographs:
        shown["residual"] = signed_map(picture.residual, RESIDUAL_OF_WHITE * white, picture.valid)
    return [(name, data_uri(enlarge(image, 200))) for name, image in shown.items()]


def _charts(history: list[dict[str, Any]]) -> list[tuple[str, str]]:
    # Leave out steps that fit one tooth of a jaw alone, because their scale differs from that of the whole jaw.
    history = [entry for entry in history if entry.get("tooth") is None]
    channels = list(dict.fromkeys(str(entry.get("channel", "")) for entry in history))

    def lines(key: str) -> list[Series]:
        rows = [
            [e for e in history if str(e.get("channel", "")) == channel and e.get(key) is not None]
            for channel in channels
        ]
        return [
            Series(channel, tuple((float(e["step"]), float(e[key])) for e in part))
            for channel, part in zip(channels, rows, strict=True)
        ]

    charts = [
        ("Loss", log_chart("Loss by step", "step", "loss", lines("loss"))),
        (
            "Held-out error",
            log_chart("Held-out error by step", "step", "held-out error", lines("held_out_error"), percent=True),
        ),
    ]
    return [(name, chart) for name, chart in charts if chart]


def _stages(history: list[dict[str, Any]]) -> list[dict[str, str]]:
    # Result of each stage of each channel: its last step.
    last: dict[tuple[str, str], dict[str, Any]] = {}
    for entry in history:
        if entry.get("stage") and entry.get("tooth") is None:
            last[str(entry.get("channel", "")), str(entry["stage"])] = entry
    rows = []
    for (channel, stage), entry in last.items():
        error, se = entry.get("held_out_error"), entry.get("held_out_se")
        error_text = "" if error is None else percent(Figure(value=error, se=se))
        rows.append(
            {
                "channel": channel,
                "stage": stage,
                "step": str(entry["step"]),
                "loss": f"{entry['loss']:.3g}",
                "error": error_text,
            }
        )
    return rows


def _parameter_rows(parameters: dict[str, dict[str, Estimate]]) -> list[dict[str, Any]]:
    names = list(dict.fromkeys(name for table in parameters.values() for name in table))
    rows = []
    for name in sorted(names, key=_order):
        present = [table[name] for table in parameters.values() if name in table]
        unit = "" if present[0].unit == "1" else present[0].unit
        rows.append(
            {
                "group": _group(name),
                "label": _label(name),
                "name": name,
                "unit": unit,
                "cells": [cell(t.get(name)) for t in parameters.values()],
            }
        )
    return rows


def _is_leading(name: str) -> bool:
    return name.rpartition(".")[2] in LEADING or name.startswith("shape.")


def _source_label(name: str) -> str:
    # Label of a parameter; one of a jaw's tooth, such as "11.enamel.sigma_a", begins with the tooth's number.
    fdi, _, own = name.partition(".")
    return f"{fdi} {_group(own).lower()}, {_label(own)}" if fdi.isdigit() else f"{_group(name)}, {_label(name)}"


def _tooth_rows(teeth: dict[str, ToothReport]) -> list[dict[str, Any]]:
    # One row per tooth and channel: its image errors, and the parameters that images determine best.
    names = [f"{part}.{leaf}" for part in ("enamel", "dentin") for leaf in LEADING[:2]]
    return [
        {
            "fdi": fdi,
            "state": tooth.state,
            "channel": channel,
            "errors": [
                _percent(errors[channel]) if channel in errors else ""
                for errors in (tooth.held_out_error, tooth.fit_error)
            ],
            "cells": [cell(table.get(name)) for name in names],
        }
        for fdi, tooth in teeth.items()
        for channel, table in tooth.parameters.items()
    ]


def _correlations(correlations: dict[str, Correlation]) -> list[dict[str, Any]]:
    # Leave out channels with one coordinate only. Blue marks positive and orange negative correlation, on light and
    # dark pages.
    def cell(value: float, own: bool) -> tuple[str, str]:
        colour = "80, 140, 220" if value > 0 else "230, 140, 60"
        return ("1", "none") if own else (f"{value:+.2f}".replace("-", "−"), f"rgba({colour}, {0.45 * abs(value):.2f})")

    tables = []
    for channel, found in correlations.items():
        if len(found.names) > 1:
            labels = [_symbol(name) for name in found.names]
            rows = [
                (label, [cell(v, a == b) for b, v in enumerate(row)])
                for a, (label, row) in enumerate(zip(labels, found.matrix, strict=True))
            ]
            tables.append({"channel": channel, "labels": labels, "rows": rows})
    return tables


def _symbol(name: str) -> str:
    part, _, leaf = name.partition(".")
    if part == "shape":
        return f"c {SHAPE_LABELS[int(leaf)]}" if leaf.isdigit() and int(leaf) < len(SHAPE_LABELS) else name
    return f"{part} {LEAF_LABELS.get(leaf, leaf).rpartition(' ')[2]}"


def _order(name: str) -> tuple[int, int]:
    part, _, leaf = name.partition(".")
    parts = list(PART_LABELS)
    return parts.index(part) if part in parts else len(parts), LEADING.index(leaf) if leaf in LEADING else len(LEADING)


def _group(name: str) -> str:
    part = name.partition(".")[0]
    return PART_LABELS.get(part, "Other")


def _label(name: str) -> str:
    part, _, leaf = name.partition(".")
    if part == "shape" and leaf.isdigit() and int(leaf) < len(SHAPE_LABELS):
        return f"weight c, {SHAPE_LABELS[int(leaf)]}"
    return LEAF_LABELS.get(leaf, name)


def _provenance(boundary: str, context: dict[str, Any]) -> Sequence[tuple[str, str]]:
    surface = {
        "matched": "index matched: light crosses the surface unaltered",
        "thin": f"thin dielectric layer, index {context.get('ior', '')}",
    }
    rows = [("Surface model", surface[boundary])] if boundary in surface else []
    return rows + [(str(label), str(text)) for label, text in context.get("provenance", {}).items()]
