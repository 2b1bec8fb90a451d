"""Motion of the jaws in one camera's view over the frames of a capture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError, SettingsError
from services.core.geometry import Light
from services.core.records import Motion
from services.core.results import FrameRecord
from services.preprocess.stabilisation.null_hypothesis import decided
from services.preprocess.stabilisation.outline import OutlineMatcher
from services.preprocess.stabilisation.stabilise import TERMS, Aligner, FloatArray, SurfaceFlow, interpolate
from services.preprocess.views.flow_comparison import FlowComparison, compare_flow
from services.preprocess.views.projection import Footprint
from services.preprocess.views.source import FootprintIn, MatchedFrame, Motions, MotionSource, View
from services.preprocess.views.window import Window

Image = NDArray[np.float32]
# Largest accepted median displacement, as a fraction of a jaw's shorter side: beyond it the coarse-to-fine alignment
# may lock on to the wrong edge
LIMIT_OF_EXTENT = 1 / 6
# Margin around the view for the largest accepted motion, as a multiple of that limit and in pixels. It exceeds the
# limit, because the limit holds for the median displacement and not for the maximum
REACH_OF_LIMIT, REACH_PX = 1.25, 8
# Smallest reach of the search for an outline, pixels: small teeth are sought for at least as far as a subject moves
MIN_REACH_PX = 4.0
# Largest number of pixels at which a displacement field is stored
STORED_PIXELS = 250_000
# Approximate number of pixels from which the median displacement is computed
MEDIAN_PIXELS = 20_000
# Smallest standard error of a motion by tracking frames, pixels: what known warps of real photographs leave
TRACKING_ERROR_PX = 0.03
# Largest estimated error of a motion interpolated between three tracking frames or more, pixels; an image made from a
# less certain frame is masked
UNCERTAIN_PX = 0.5
# Share of a camera's images beyond which they are most of them
MAJORITY = 0.5
# Least number of tracking frames whose interpolation has an error estimate good enough to mask images by
JUDGED_KNOTS = 3


def stored_step(shape: tuple[int, int]) -> int:
    """Spacing in pixels at which the displacements of an image (height, width) are stored: the field is smooth."""
    return int(np.ceil(np.sqrt(shape[0] * shape[1] / STORED_PIXELS)))


def jaws(fdi: Sequence[int]) -> list[list[int]]:
    """Indices of the upper and of the lower teeth in a list of FDI numbers; each jaw moves as one rigid body."""
    upper = [k for k, number in enumerate(fdi) if number // 10 in {1, 2, 5, 6}]
    return [group for group in (upper, [k for k in range(len(fdi)) if k not in upper]) if group]


def frames_to_match(frames: Sequence[FrameRecord], motion: Motion) -> tuple[FrameRecord, ...]:
    """Frames whose motion is measured: the tracking frames, which share one light, or else one frame for each light.

    With fewer than two tracking frames and ``auto`` the outline of the teeth is looked for under every light. Of
    consecutive exposures of one light the first represents all. A short exposure may be all noise and a long one
    saturated, so that neither shows an outline, and the subject hardly moves between them. A subject that cannot move
    needs no frame.

    Raises:
        SettingsError: motion is to be found by tracking frames, and there are fewer than two.
    """
    if motion == "off":
        return ()
    tracking = tuple(frame for frame in frames if frame.kind == "tracking")
    if len(tracking) >= 2:
        return tracking
    if motion == "tracking":
        raise SettingsError(
            f"motion = 'tracking' needs two tracking frames of every camera, and one has {len(tracking)}; give 'off'"
            " for a subject that cannot move, or 'auto'."
        )
    return tuple(own[0] for own in group_exposures(frames) if own[0].kind == "light")


def group_exposures(frames: Sequence[FrameRecord]) -> list[tuple[FrameRecord, ...]]:
    """Group consecutive frames of the same kind and light, in order."""
    return [tuple(own) for _, own in groupby(frames, key=lambda frame: (frame.kind, frame.light))]


@dataclass(frozen=True)
class Displacement:
    """Displacement of the reference frame's pixels in another frame.

    Attributes:
        coefficients: (bodies, TERMS, 2), pixels.
        median_px: median length over a jaw's teeth, of the jaw that moved most.
        error_px: standard error of either component; 0 for a subject that is stated not to move.
        uncertain: whether an image with this motion is to be masked.
    """

    coefficients: FloatArray
    median_px: float
    error_px: float
    uncertain: bool = False


@dataclass(frozen=True)
class Scene:
    """What an outline is compared with.

    Attributes:
        lights: lights of the capture.
        footprint_in: gives the surfaces that a camera sees.
    """

    lights: Sequence[Light]
    footprint_in: FootprintIn


def largest_error_px(moves: Sequence[Displacement]) -> float:
    """Largest standard error of some displacements."""
    return max(move.error_px for move in moves)


def is_uncertain(moves: Sequence[Displacement]) -> bool:
    """Whether an image made from frames with these displacements is to be masked."""
    return any(move.uncertain for move in moves)


class ViewMotion:
    """Motion of the subject relative to the first frame, for every light frame.

    It is measured between tracking frames and interpolated over the frame number, because frames are triggered at even
    intervals and the number does not depend on the host's clock. Without tracking frames a light's images stay where
    they are unless the outline of the teeth tells otherwise.
    """

    def __init__(
        self, view: View, bodies: Sequence[Sequence[int]], frames: Sequence[FrameRecord], motion: Motion
    ) -> None:
        """Prepare the possible displacements of each body.

        Args:
            view: window and footprint of the camera.
            bodies: mesh numbers in the footprint, for each rigid body.
            frames: all frames of the capture.
            motion: how motion is found.
        """
        self._view = view
        self._matched = frames_to_match(frames, motion)
        self._interpolated = bool(self._matched) and self._matched[0].kind == "tracking"
        measured: MotionSource = "tracking" if self._interpolated else "outline"
        self.source: MotionSource = measured if self._matched else "stated still"
        """What the motion is known from."""
        self._representative = {frame.index: own[0].index for own in group_exposures(frames) for frame in own}
        visible = [np.isin(view.footprint.mesh, list(meshes)) for meshes in bodies]
        sides_px = [_shorter_side(one) for one in visible if one.any()]
        reach_px = int(np.ceil(REACH_OF_LIMIT * LIMIT_OF_EXTENT * max(sides_px))) + REACH_PX
        self.window: Window = view.window.grown(reach_px, view.whole.size)
        """The view's window enlarged by the largest accepted motion."""
        self._inner = view.window.within(self.window)
        embedded = _embedded(view.footprint, self.window.shape, self._inner)
        flows = [SurfaceFlow(embedded, meshes, view.scratch_file(f"relief-{k}")) for k, meshes in enumerate(bodies)]
        self._bodies = [body for body in flows if body.visible.any()]
        self._meshes = [meshes for body, meshes in zip(flows, bodies, strict=True) if body.visible.any()]
        self._reach_px = max(REACH_OF_LIMIT * LIMIT_OF_EXTENT * max(sides_px, default=0), MIN_REACH_PX)
        # Compute medians from evenly strided pixels only
        self._step = max(1, int(np.sqrt(np.prod(view.window.shape) / MEDIAN_PIXELS)))

    def measure(
        self,
        frames: Sequence[int],
        picture: Callable[[FrameRecord], NDArray[np.generic]],
        scene: Scene,
        level: float = 0.0,
    ) -> Iterator[tuple[int, MatchedFrame]]:
        """Yield each frame's number and what was measured of its motion.

        Args:
            frames: numbers of some of ``frames_to_match``.
            picture: gives the values (H, W) or (H, W, C) of a frame, or of the frames that it represents, in
                ``window``; they are linear in light above ``level``.
            scene: what outlines are compared with.
            level: value of a pixel without light.

        Raises:
            CaptureInputError: the subject moved too far to be aligned; the message names the frame and the camera.
        """
        if not frames:
            return
        if not self._interpolated:
            yield from self._outlines(frames, picture, scene, level)
            return
        first = self._matched[0]
        reference = picture(first)
        aligners = [Aligner(body, reference, level) for body in self._bodies]
        for frame in self._matched:
            if frame.index not in frames:
                continue
            if frame.index == first.index:
                yield frame.index, MatchedFrame(np.zeros((len(self._bodies), TERMS, 2)))
                continue
            image = picture(frame)
            found = np.asarray([aligner.solve(image) for aligner in aligners]).reshape(-1, TERMS, 2)
            for body, coefficients in zip(self._bodies, found, strict=True):
                moved, limit = self._median(body, coefficients), LIMIT_OF_EXTENT * body.extent_px
                if moved > limit:
                    raise CaptureInputError(
                        f"The subject moved {moved:.1f} px by frame {frame.index} (camera {self._view.whole.name}, "
                        f"light {frame.light or 'all'}), more than the {limit:.1f} px that can be aligned; "
                        "capture again with the head supported."
                    )
            yield frame.index, MatchedFrame(found)

    def _outlines(
        self,
        frames: Sequence[int],
        picture: Callable[[FrameRecord], NDArray[np.generic]],
        scene: Scene,
        level: float,
    ) -> Iterator[tuple[int, MatchedFrame]]:
        camera, place_mm = self.window.cropped(self._view.whole), {one.name: one.position_mm for one in scene.lights}
        matchers = [
            OutlineMatcher(camera, meshes, body.visible, self._reach_px, scene.footprint_in)
            for body, meshes in zip(self._bodies, self._meshes, strict=True)
        ]
        for frame in self._matched:
            if frame.index not in frames:
                continue
            assert frame.light is not None
            image = picture(frame)
            found = [matcher.match(image, place_mm[frame.light], level) for matcher in matchers]
            coefficients = np.zeros((len(self._bodies), TERMS, 2))
            coefficients[:, 0] = np.reshape([one.shift_px for one in found], (-1, 2))
            errors_px, arcs_px = tuple(one.error_px for one in found), tuple(one.arcs_px for one in found)
            yield frame.index, MatchedFrame(coefficients, errors_px, arcs_px)

    def at(self, frame: FrameRecord, motions: Motions) -> Displacement:
        """Displacement of one frame.

        Args:
            frame: any frame of the capture.
            motions: what was measured of all ``frames_to_match``.
        """
        if not self._matched:
            return Displacement(np.zeros((len(self._bodies), TERMS, 2)), 0.0, 0.0)
        if not self._interpolated:
            return self._by_outline(frame, motions)
        index = np.array([matched.index for matched in self._matched], dtype=np.float64)
        knots = np.stack([motions[matched.index].coefficients for matched in self._matched])
        coefficients, error = interpolate(index, knots, float(frame.index))
        medians = [self._median(body, c) for body, c in zip(self._bodies, coefficients, strict=True)]
        # Take the error of the shift as that of the field, because the other terms are small beside it
        interpolation_px = float(np.linalg.norm(error[:, 0], axis=-1).max(initial=0.0))
        error_px = float(np.hypot(interpolation_px, TRACKING_ERROR_PX))
        uncertain = len(knots) >= JUDGED_KNOTS and interpolation_px > UNCERTAIN_PX
        return Displacement(coefficients, max(medians, default=0.0), error_px, uncertain)

    def _by_outline(self, frame: FrameRecord, motions: Motions) -> Displacement:
        own = [matched.index for matched in self._matched].index(self._representative[frame.index])
        coefficients, errors, uncertain = np.zeros((len(self._bodies), TERMS, 2)), [0.0], False
        for number in range(len(self._bodies)):
            found = [motions[matched.index] for matched in self._matched]
            measured_px = np.array([one.error_px[number] for one in found])
            shifts, error_px = decided(
                np.array([one.coefficients[number, 0] for one in found]),
                measured_px,
                np.array([one.arcs_px[number] for one in found]),
            )
            # An image without the outline that most others show is masked. Where most show none, nothing tells a motion
            is_known = np.isfinite(measured_px)
            uncertain |= bool(not is_known[own] and is_known.mean() > MAJORITY)
            coefficients[number, 0] = shifts[own]
            errors.append(float(error_px[own]))
        medians = np.linalg.norm(coefficients[:, 0], axis=-1)
        return Displacement(coefficients, float(medians.max(initial=0.0)), max(errors), uncertain)

    def positions(self, displacement: Displacement, rows: slice) -> Image:
        """Positions in a frame of some rows of the view: x and y (2, rows, width) as indices into ``window``."""
        own_rows, columns = self._rows(rows), self._inner[1]
        positions = self._bodies[0].positions(displacement.coefficients[0], own_rows, columns)
        for body, coefficients in zip(self._bodies[1:], displacement.coefficients[1:], strict=True):
            visible = body.visible[own_rows, columns]
            if visible.any():
                np.copyto(positions, body.positions(coefficients, own_rows, columns), where=visible)
        return positions

    def flow_comparison(
        self, picture: Callable[[FrameRecord], NDArray[np.generic]], motions: Motions
    ) -> FlowComparison | None:
        """Optical flow to the tracking frame that moved most, before and after stabilisation; None without two of them.

        Args:
            picture: gives the values of a frame in ``window``.
            motions: what was measured of all ``frames_to_match``.
        """
        if not self._interpolated or len(self._matched) < 2 or not self._bodies:
            return None
        moves = [self.at(frame, motions) for frame in self._matched]
        farthest = max(range(len(moves)), key=lambda k: moves[k].median_px)
        # If no frame moved, compare the last one with the first
        farthest = farthest or len(moves) - 1
        positions = self.positions(moves[farthest], slice(0, self._view.window.shape[0]))
        first, moved = (picture(self._matched[k]) for k in (0, farthest))
        teeth = self._view.footprint.covered & np.any([body.visible[self._inner] for body in self._bodies], axis=0)
        return compare_flow(self._matched[farthest].index, first, moved, self._inner, positions, teeth)

    def stored_field(self, displacement: Displacement) -> Image:
        """Displacement (h, w, 2) at every ``stored_step``-th pixel of the whole image that lies in the view.

        Pixels that show no tooth get the displacement of the first jaw.
        """
        width, height = self._view.whole.size
        step = stored_step((height, width))
        window = self._view.window
        rows, columns = (
            slice(start + -whole % step, stop, step)
            for (start, stop), whole in zip(
                ((own.start, own.stop) for own in self._inner), (window.top, window.left), strict=True
            )
        )
        field = self._bodies[0].field(displacement.coefficients[0], rows, columns)
        for body, coefficients in zip(self._bodies[1:], displacement.coefficients[1:], strict=True):
            field = np.where(body.visible[rows, columns, None], body.field(coefficients, rows, columns), field)
        return field

    def _rows(self, rows: slice) -> slice:
        top = self._inner[0].start
        return slice(top + rows.start, top + rows.stop)

    def _median(self, body: SurfaceFlow, coefficients: FloatArray) -> float:
        rows, columns = (slice(own.start, own.stop, self._step) for own in self._inner)
        visible = body.visible[rows, columns]
        if not visible.any():
            return 0.0
        return float(np.median(np.linalg.norm(body.field(coefficients, rows, columns)[visible], axis=-1)))


def _shorter_side(visible: NDArray[np.bool_]) -> int:
    return min(int(np.ptp(np.flatnonzero(visible.any(axis=axis)))) + 1 for axis in (0, 1))


def _embedded(footprint: Footprint, shape: tuple[int, int], inner: tuple[slice, slice]) -> Footprint:
    """Embed a footprint in a larger window without surfaces around it; the normals are not enlarged."""
    mesh, covered = np.full(shape, -1, dtype=np.int16), np.zeros(shape, dtype=bool)
    depth_mm = np.full(shape, np.inf, dtype=np.float32)
    mesh[inner], covered[inner], depth_mm[inner] = footprint.mesh, footprint.covered, footprint.depth_mm
    return Footprint(mesh, depth_mm, footprint.normal, covered)
