"""The figures of teeth 2018 that compare fits with photographs, each with its errors in its caption."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from services.bench.figures.cases import Case
from services.bench.figures.figure_cases import (
    FIVE_LIGHTS,
    FIVE_OTHERS,
    FRONT_LIGHTS,
    SIDE_LIGHTS,
    SPREAD_LIGHTS,
    FigureCases,
)
from services.bench.figures.fitted import Comparisons, Fitted, Image, error_of, loss_of
from services.bench.figures.mosaic import RESIDUAL_LIMIT, Column, cropped, mosaic, photo_and_fit
from services.core.pages.pictures import Image8, signed_map, tone_map, white_level
from services.fit.coordinates.domain import similar_tissue
from services.fit.stages.tooth.schedule import SIMILAR_G

DIFFERENCE = f"Differences are fit minus photograph, blue to orange within ±{100 * RESIDUAL_LIMIT:.0f} % of white."


@dataclass(frozen=True)
class Drawn:
    """A figure and the caption below it."""

    picture: Image8
    caption: str


def front_and_side(cases: FigureCases) -> Drawn:
    """Draw fig. 8: nine front lights, which were fitted, and a side view and nine side lights, which were not."""
    comparisons = Fitted(cases.front.fitted(cases.work)).compared(cases.effort.shown_samples)
    groups = [("c1", FRONT_LIGHTS), ("c2", FRONT_LIGHTS), ("c1", SIDE_LIGHTS)]
    rows = [
        [drawn for camera, lights in groups for drawn in _drawn(comparisons, (camera, lights[n]))]
        for n in range(len(FRONT_LIGHTS))
    ]
    columns = [
        column
        for name in ("front view", "side view", "side lights")
        for column in (Column(name, starts_group=True), Column("fit"), Column("difference"))
    ]
    errors = [error_of(comparisons, [(camera, light) for light in lights]) for camera, lights in groups]
    return Drawn(
        mosaic(rows, columns, scale=2),
        f"An isolated tooth ({cases.tooth_name}) of known dentin, fitted to nine front lights of one camera (left):"
        f" error {_percent(errors[0])}. Not fitted: a side view under the same lights (centre) {_percent(errors[1])},"
        f" and nine side lights (right) {_percent(errors[2])}. {DIFFERENCE}",
    )


def stages(cases: FigureCases) -> Drawn:
    """Draw fig. 9: a homogeneous tooth, a tooth of both media and one with stains, beside the photograph."""
    fitted = Fitted(cases.stained.fitted(cases.work))
    (channel,) = fitted.channels
    homogeneous = similar_tissue(fitted.stage_tissue(channel, "homogeneous"), SIMILAR_G)
    found = [
        fitted.compared(cases.effort.shown_samples, optics)
        for optics in (
            {channel: homogeneous},
            {channel: fitted.stage_tissue(channel, "exact")},
            {channel: fitted.optics(channel)},
        )
    ]
    names = ("homogeneous", "both media", "with stains")
    shown = [("c0", "l0"), ("c1", "l1"), ("c0", "l6"), ("c1", "l3")]
    rows = []
    for image in shown:
        pictures = [cropped(one[image].picture) for one in found]
        photo, valid = pictures[0].photo, pictures[0].valid
        white = white_level(photo, valid)
        drawn = [tone_map(np.where(valid[..., None], picture.render, 0.0), white) for picture in pictures]
        rows.append(
            [
                *drawn,
                tone_map(np.where(valid[..., None], photo, 0.0), white),
                *(signed_map(p.residual, RESIDUAL_LIMIT * white, valid) for p in pictures),
            ]
        )
    images = [(camera, light) for camera in ("c0", "c1") for light in SPREAD_LIGHTS]
    others = [image for image in found[0] if image not in images]
    losses = [loss_of(one, images) for one in found]
    heads = [f"{name}: {loss:.3f}" for name, loss in zip(names, losses, strict=True)]
    columns = [
        *(Column(head) for head in heads),
        Column("photograph", starts_group=True),
        *(Column(name, name == names[0]) for name in names),
    ]
    unseen = ", ".join(_percent(error_of(one, others)) for one in found)
    return Drawn(
        mosaic(rows, columns, [f"{camera} {light}" for camera, light in shown], scale=4),
        "Stages of the fit of a stained incisor beside the photograph, and their differences to it. The number is the"
        " loss, the relative squared error of all fitted images with their noise; it falls by"
        f" {_percent(1 - losses[1] / losses[0])} and {_percent(1 - losses[2] / losses[1])}. Error on the {len(others)}"
        f" images that were not fitted: {unseen}. Light l3 was not fitted. {DIFFERENCE}",
    )


def five_lights(cases: FigureCases) -> Drawn:
    """Draw fig. 10: three cameras under five lights, which were fitted, and under five others, which were not."""
    comparisons, cameras = (
        Fitted(cases.five_lights.fitted(cases.work)).compared(cases.effort.shown_samples),
        ("c0", "c1", "c2"),
    )
    rows = [
        [
            drawn
            for lights in (FIVE_LIGHTS, FIVE_OTHERS)
            for camera in cameras
            for drawn in _drawn(comparisons, (camera, lights[n]), difference=False)
        ]
        for n in range(len(FIVE_LIGHTS))
    ]
    columns = [Column(name, name == "photo") for _ in range(2 * len(cameras)) for name in ("photo", "fit")]
    fit, unseen = (
        error_of(comparisons, [(camera, light) for camera in cameras for light in lights])
        for lights in (FIVE_LIGHTS, FIVE_OTHERS)
    )
    return Drawn(
        mosaic(rows, columns, scale=2),
        f"One tooth in colour ({cases.tooth_name}, dentin known), fitted to three cameras under five lights (left"
        f" half): error {_percent(fit)}; under five lights that were not fitted (right half): {_percent(unseen)}.",
    )


def unseen_camera(cases: FigureCases) -> Drawn:
    """Draw fig. 13: two cameras, which were fitted, and a third one, which was not."""
    comparisons = Fitted(cases.two_cameras.fitted(cases.work)).compared(cases.effort.shown_samples)
    rows = [
        [drawn for camera in ("c0", "c1", "c2") for drawn in _drawn(comparisons, (camera, light))]
        for light in FIVE_LIGHTS
    ]
    columns = [
        column
        for name in ("c0, not fitted", "c1, fitted", "c2, fitted")
        for column in (Column(name, starts_group=True), Column("fit"), Column("difference"))
    ]
    fitted_error, unseen_error = (
        error_of(comparisons, [(camera, light) for camera in cameras for light in FIVE_LIGHTS])
        for cameras in (("c1", "c2"), ("c0",))
    )
    return Drawn(
        mosaic(rows, columns, FIVE_LIGHTS, scale=3),
        f"Two cameras fitted (c1 and c2, five lights; {cases.tooth_name}, dentin known), the third (c0, left) was not:"
        f" error {_percent(fitted_error)} on the fitted ones, {_percent(unseen_error)} on the third, a ratio of"
        f" {unseen_error / max(fitted_error, 1e-9):.2f}. {DIFFERENCE}",
    )


def whole_jaw(cases: FigureCases, subject: int) -> Drawn:
    """Draw figs. 11 and 12: all teeth of a jaw in three views."""
    return _jaw(cases, cases.jaw(subject))


def _jaw(cases: FigureCases, case: Case) -> Drawn:
    fitted = Fitted(case.fitted(cases.work))
    comparisons = fitted.compared(cases.effort.shown_samples)
    shown = [(camera, light) for camera in case.cameras for light in ("l0", "l3")]
    rows = [_drawn(comparisons, image) for image in shown]
    columns = [Column(name) for name in ("photo", "fit", "difference")]
    images = [[image for image in comparisons if case.is_fitted(*image) == is_fitted] for is_fitted in (True, False)]
    fit, unseen = (error_of(comparisons, some) for some in images)
    states = [tooth.state for tooth in fitted.report.teeth.values()]
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("fitted", "tied", "failed") if state in states)
    return Drawn(
        mosaic(rows, columns, [" ".join(image) for image in shown], scale=4),
        f"A whole upper jaw of {len(states)} teeth ({counts}) with gums and the wall of the mouth, {len(case.cameras)}"
        f" views under two of {len(case.fitted_lights)} fitted lights: error {_percent(fit)} on all fitted images,"
        f" {_percent(unseen)} under the light that was not fitted. {DIFFERENCE}",
    )


def _drawn(comparisons: Comparisons, image: Image, *, difference: bool = True) -> Sequence[Image8]:
    return photo_and_fit(cropped(comparisons[image].picture), difference=difference)


def _percent(error: float) -> str:
    return f"{100 * error:.1f} %"


def caption_page(captions: Iterable[tuple[str, str]]) -> str:
    """Return an HTML page of all figures.

    Args:
        captions: for each figure the name of its file without the suffix, and its caption.
    """
    from html import escape

    parts = [
        f'<figure><img src="{escape(name)}.png" alt="{escape(name)}"><figcaption><b>{escape(name)}</b>'
        f" {escape(text)}</figcaption></figure>"
        for name, text in captions
    ]
    style = "body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto}img{max-width:100%}figure{margin:0 0 3em}"
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>Figures</title><style>{style}</style>"
    return f"{head}<body>{''.join(parts)}</body></html>\n"
