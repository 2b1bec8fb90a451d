"""Signs of mistakes in a calibration session, each as a sentence with its remedy."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from services.calibrate.cameras.bundle import project_corners
from services.calibrate.lights.listed import swapped_names
from services.calibrate.lights.mirror import outline_errors
from services.calibrate.session.boards import CamerasStep
from services.calibrate.session.charts import ColourStep, better_order, with_red_for_blue
from services.calibrate.session.highlights import about_highlights
from services.calibrate.session.photos import Black
from services.calibrate.session.spheres import IntensityStep, LightsStep
from services.core.raw.records import RawFolder
from services.core.robust import robust_sigma

MAX_EDGE_SHIFT_PX = 1.0
"""Largest edge shift of a camera. Edges are located to half a pixel; if all of them lie further out or in, the sphere's
radius is not the stated one."""
MAX_BAD_SHARE = 0.5
"""Largest fraction of outliers among a view's corners: single corners are outliers where they are hidden or glare, most
of them only where the pose is wrong."""
MAX_FOCAL_SE = 0.01
"""Largest relative standard error of a focal length: ten tilted boards give a thousandth, boards that all face the
camera several per cent."""
MIN_APART_MM = 1.0
"""Smallest distance between two lights: lamps are wider than this."""
MANY_SIGMAS = 6.0
"""Residual of a photograph in robust standard deviations beyond which it is suspect: among a hundred photographs of
three channels one exceeds it by chance once in a million sessions."""
MIN_OFF_SHARE = 0.03
"""Smallest relative residual of a suspect photograph: paint, shadow and glare cause a per cent, another light or
exposure more than three."""
MIN_MOVE_PX = 1.0
"""Smallest rms residual of an outline that counts as that of a moved sphere."""
MOVED_TIMES = 4.0
"""Ratio of an outline's rms residual to the median of all beyond which the sphere has moved: where it moved between
photographs, its outlines disagree by pixels."""
MAX_BLACK_SHARE = 0.1
"""Largest black level as a fraction of the range: cameras set it to a few per cent."""
LONG_EXPOSURE_S = 10.0
"""Exposure in s that is taken for one in ms: lamps near teeth need some hundredths of a second."""
MAX_SCALE_ERROR = 0.03
"""Largest relative error of a list's scale: a list measured by hand is right to 10 mm in a metre, and 3 % mean another
unit or another board."""


def suspicions(
    folder: RawFolder,
    cameras: CamerasStep,
    lights: LightsStep | None,
    intensity: IntensityStep | None = None,
    colours: ColourStep | None = None,
    black: Mapping[str, Black] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Yield a sentence for everything that looks wrong; none for a good session.

    Args:
        folder: the raw folder's description.
        cameras: result of the cameras' step.
        lights: result of the mirror spheres' step.
        intensity: result of the white spheres' step.
        colours: result of the colours' step.
        black: black level by camera.
        inputs: SHA-256 of each file.
    """
    names = [light.name for light in folder.light]
    yield from _about_files(folder, black or {}, inputs or {})
    yield from _about_boards(cameras)
    if lights is not None:
        yield from _about_spheres(cameras, lights)
        yield from about_highlights(folder, cameras, lights)
        yield from _about_the_list(names, lights)
        yield from _twins(names, lights)
    if intensity is not None:
        yield from _about_white(names, cameras, intensity)
    if colours is not None:
        yield from _about_the_chart(colours)


def _about_files(folder: RawFolder, black: Mapping[str, Black], inputs: Mapping[str, str]) -> Iterator[str]:
    used = {frame.file for frame in folder.frame}
    same = defaultdict(list)
    for file, digest in inputs.items():
        if file in used:
            same[digest].append(file)
    for first, second, *_ in (files for files in same.values() if files[1:]):
        yield f"Files {first} and {second} hold the same photograph; export the second again, or list it once."
    if long := [frame for frame in folder.frame if frame.exposure_s >= LONG_EXPOSURE_S]:
        yield (
            f"{len(long)} frames are said to be exposed for {LONG_EXPOSURE_S:g} s and longer, among them"
            f" {long[0].file}; give exposure_s in seconds, 0.02 for 20 ms."
        )
    for name, level in black.items():
        camera = folder.camera_named(name)
        full = camera.full_counts
        if full is not None and level.counts > MAX_BLACK_SHARE * full:
            yield (
                f"Black frames of camera {name} have {level.counts:.0f} counts of {full:.0f}: light fell in; "
                "take them again with the lens covered."
            )


def _about_boards(cameras: CamerasStep) -> Iterator[str]:
    fit = cameras.fit
    missed = defaultdict(list)
    for file, why in cameras.missed:
        missed[why].append(file)
    for why, files in missed.items():
        many = f"{len(files)} frames show no board, among them {files[0]}"
        yield f"{many if files[1:] else f'Frame {files[0]} shows no board'}: {why}."
    if not fit.converged:
        yield (
            "The adjustment of cameras and boards stopped before it settled, so its errors cannot be trusted: look for"
            " boards that moved while the cameras took them, and photograph more places and tilts."
        )
    for number, name in enumerate(cameras.names):
        columns = fit.layout.lens_columns(number)[:2]
        focal = fit.rig.lenses[number].values[0]
        if len(columns) and np.sqrt(fit.covariance[columns[0], columns[0]]) > MAX_FOCAL_SE * focal:
            yield (
                f"Boards tell the focal length of camera {name} to"
                f" {np.sqrt(fit.covariance[columns[0], columns[0]]) / focal:.1%} only: they all face it alike; tilt"
                " them by 20° to 40° in several directions."
            )
    for number, view in enumerate(cameras.views):
        mine = fit.corners.view == number
        if (~fit.inliers[mine]).mean() > MAX_BAD_SHARE:
            yield _of_a_bad_view(cameras, number, view.name)


def _of_a_bad_view(cameras: CamerasStep, number: int, name: str) -> str:
    """Return a sentence that says whether a view with many outliers belongs to another place or to another camera, or
    else that something moved.
    """
    fit = cameras.fit
    corners = fit.corners.selected(fit.corners.view == number)
    limit = 10 * float(fit.sigma_px.max())

    def median_error_px(camera: int, place: int) -> float:
        described = replace(
            corners, camera=np.full_like(corners.camera, camera), place=np.full_like(corners.place, place)
        )
        return float(np.median(np.abs(corners.pixels - project_corners(fit.rig, described))))

    camera, place = int(corners.camera[0]), int(corners.place[0])
    for other in range(len(fit.rig.places)):
        if other != place and median_error_px(camera, other) < limit:
            there = next(view.name for view in cameras.views if view.place == other)
            return f"Frame {name} shows the board as it lay for {there}; frames of two places are interchanged."
    for other in range(len(cameras.names)):
        if other != camera and median_error_px(other, place) < limit:
            return (
                f"Frame {name} is what camera {cameras.names[other]} sees and not {cameras.names[camera]}; "
                "frames of two cameras are interchanged."
            )
    return (
        f"Most corners of {name} fit no pose: the board or the camera moved there between photographs; leave the place"
        " out or take it again."
    )


def _about_spheres(cameras: CamerasStep, lights: LightsStep) -> Iterator[str]:
    fit = lights.fit
    for number, shift in enumerate(fit.edge_shifts_px):
        if abs(shift) > MAX_EDGE_SHIFT_PX:
            yield (
                f"Outlines of the mirror spheres lie {shift:+.1f} px from where their radius says in camera"
                f" {cameras.names[number]}; measure the sphere's radius_mm and the board's square_mm again."
            )
    rms = np.empty(len(lights.views))
    for number, view in enumerate(lights.views):
        off = outline_errors(fit.cameras[view.camera], view.outline_px, fit.centres_mm[view.place], view.radius_mm)
        rms[number] = np.sqrt(np.mean((off - fit.edge_shifts_px[view.camera]) ** 2))
    moved = {
        view.place: name
        for view, name, one in zip(lights.views, lights.view_names, rms, strict=True)
        if one > max(MIN_MOVE_PX, MOVED_TIMES * float(np.median(rms)))
    }
    for name in moved.values():
        yield (
            f"The sphere's outline in {name} does not fit those of the other cameras: it moved, or the place is"
            " another; keep the sphere still until all lights and cameras are through."
        )


def _about_the_list(names: list[str], lights: LightsStep) -> Iterator[str]:
    aligned = lights.aligned
    if aligned is None:
        return
    if abs(aligned.scale - 1) > MAX_SCALE_ERROR:
        yield (
            f"Lights are {aligned.scale:.3g} times as far apart as raw.toml lists them: check the unit of position_mm, "
            "and the board's square_mm."
        )
        return
    if aligned.is_mirrored:
        yield (
            "The lights' list is of a left-handed frame, as its mirror image fits; change the sign of one axis in"
            " position_mm."
        )
        return
    found = np.full((len(names), 3), np.nan)
    found[lights.fit.lights] = lights.fit.positions_mm
    swapped = dict(swapped_names(found, aligned))
    for number in aligned.outliers:
        if number in swapped:
            yield (
                f"Light {names[number]} shines where the list has {names[swapped[number]]}; their names are"
                " interchanged."
            )
        else:
            off = aligned.distances_mm[number]
            yield f"Light {names[number]} lies {off:.0f} mm from where the list has it; measure it again."


def _twins(names: list[str], lights: LightsStep) -> Iterator[str]:
    """Yield a sentence for each pair of lights at one position, which are one light under two names."""
    positions = lights.fit.positions_mm
    for one in range(len(positions)):
        for two in range(one):
            apart = float(np.linalg.norm(positions[one] - positions[two]))
            if apart < MIN_APART_MM:
                first, second = names[lights.fit.lights[two]], names[lights.fit.lights[one]]
                yield (
                    f"Lights {first} and {second} lie {apart:.1f} mm apart: one light was photographed under two names."
                )


def _about_white(names: list[str], cameras: CamerasStep, intensity: IntensityStep) -> Iterator[str]:
    """Yield a sentence for each photograph of a white sphere that shows another light, or whose brightness disagrees
    with the other photographs; one sentence for two lights whose photographs are all interchanged.
    """
    others = intensity.lit_by_others
    interchanged = _interchanged(intensity)
    for one, two in sorted(interchanged):
        yield (
            f"White spheres under light {names[one]} are shaded as by {names[two]}, and those under {names[two]} as by"
            f" {names[one]}: the two lights' names are interchanged, in the frames of the mirror sphere or in those of"
            " the white sphere; correct the key light in one of them."
        )
    explained = {light for pair in interchanged for light in pair}
    off = intensity.fit.residuals.mean(axis=1)
    limit = max(MANY_SIGMAS * robust_sigma(off), MIN_OFF_SHARE)
    brightness = dict(zip(intensity.fit.used, off.tolist(), strict=True))
    for number, photo in enumerate(intensity.photos):
        if photo.light in explained:
            continue
        file = f" ({photo.file})" if photo.file else ""
        white = f"The white sphere under light {names[photo.light]} in camera {cameras.names[photo.camera]}{file}"
        if number in others:
            yield f"{white} is shaded as by light {names[others[number]]}; correct the light of this frame."
        elif abs(brightness.get(number, 0.0)) > limit:
            yield (
                f"{white} is {100 * np.expm1(brightness[number]):+.0f} % off: another light was on, or its exposure,"
                " gain or level is not what raw.toml says."
            )


def _about_the_chart(colours: ColourStep) -> Iterator[str]:
    in_other_order = better_order(colours)
    for camera, (order, better, worse) in in_other_order.items():
        yield (
            f"The chart's patches in camera {camera} fit far better {order} (ΔE2000 {better:.1f} against {worse:.1f}): "
            "give corners_px as the centres of patches 1, 6, 24 and 19 in this order."
        )
    for camera in with_red_for_blue(colours):
        if camera not in in_other_order:
            yield (
                f"The chart's colours in camera {camera} are right with red and blue interchanged; correct mosaic, or"
                " the order of the channels in its files."
            )
    for camera, rgb in colours.rgb.items():
        unusable = np.flatnonzero(~np.isfinite(rgb).all(axis=1)) + 1
        if len(unusable):
            yield (
                f"{len(unusable)} of {len(rgb)} patches of the chart in camera {camera} are saturated or outside the"
                f" image, the first of them patch {unusable[0]}, and were left out; expose the chart less, or correct"
                " corners_px."
            )


def _interchanged(intensity: IntensityStep) -> set[tuple[int, int]]:
    """Return the pairs of lights, smaller number first, whose photographs mostly show the other one."""
    shown = Counter(photo.light for photo in intensity.photos)
    seen = Counter((intensity.photos[number].light, other) for number, other in intensity.lit_by_others.items())
    mostly = {pair for pair, count in seen.items() if 2 * count > shown[pair[0]]}
    return {(one, two) for one, two in mostly if one < two and (two, one) in mostly}
