"""Highlights on mirror spheres that disagree with the other ones of their light, each as a sentence with its remedy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from services.calibrate.lights.mirror import highlight_points
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.spheres import LightsStep, place_of
from services.core.raw.records import RawFolder

Key = tuple[int, int, int]
"""Camera, place and light."""
SAME_PX = 3.0
"""Largest distance in px at which a highlight is that of another light: highlights are found to a tenth of a pixel, and
those of two lights lie many pixels apart."""


def about_highlights(folder: RawFolder, cameras: CamerasStep, lights: LightsStep) -> Iterator[str]:
    """Yield a sentence for two lights whose frames are interchanged at a place, for a frame that shows another light
    than the stated one, for each other highlight that was left out, and for frames without a highlight.
    """
    names, shown = [light.name for light in folder.light], _shown_lights(lights)
    places = {view.place: name.split(", ", 1)[1] for view, name in zip(lights.views, lights.view_names, strict=True)}

    def files(keys: Sequence[Key]) -> str:
        wanted = {(cameras.names[camera], places[place], names[light]) for camera, place, light in keys}
        return ", ".join(
            frame.file
            for frame in folder.frame
            if frame.kind == "mirror-sphere" and (frame.camera, place_of(frame), frame.light) in wanted
        )

    exchanged: dict[tuple[int, int, int], list[Key]] = {}
    for (camera, place, light), other in shown.items():
        if light < other and shown.get((camera, place, other)) == light:
            exchanged.setdefault((place, light, other), []).extend([(camera, place, light), (camera, place, other)])
    for (place, one, two), keys in exchanged.items():
        yield (
            f"At place {places[place]} the frames of lights {names[one]} and {names[two]} are interchanged; correct the"
            f" key light of {files(keys)}."
        )
    explained = {key for keys in exchanged.values() for key in keys}
    for outlier in lights.fit.outliers:
        key = (outlier.camera, outlier.place, outlier.light)
        if key in explained:
            continue
        if key in shown:
            yield f"Frame {files([key])} shows the highlight of light {names[shown[key]]}; correct its key light."
        else:
            yield (
                f"The highlight of light {names[outlier.light]} in {files([key])} is {outlier.residual_px:.1f} px off:"
                " something else may shine there, so it was left out."
            )
    if lights.no_highlight:
        yield (
            f"{len(lights.no_highlight)} frames show no highlight, among them {lights.no_highlight[0]}: was the"
            " light on?"
        )


def _shown_lights(lights: LightsStep) -> Mapping[Key, int]:
    """Return, for the highlights that were left out, the light whose highlight the fit has at their pixel, if any."""
    fit, shown = lights.fit, {}
    left_out = {(outlier.camera, outlier.place, outlier.light) for outlier in fit.outliers}
    for view in lights.views:
        camera, centre = fit.cameras[view.camera], fit.centres_mm[view.place]
        points = highlight_points(camera.centre_mm, fit.positions_mm, centre, view.radius_mm)
        drawn_px = camera.project(points)
        for light, seen_px in zip(view.lights.tolist(), view.highlights_px, strict=True):
            apart = np.linalg.norm(drawn_px - seen_px, axis=1)
            nearest = int(np.argmin(apart))
            key = (view.camera, view.place, light)
            if key in left_out and apart[nearest] < SAME_PX:
                shown[key] = int(fit.lights[nearest])
    return shown
