"""Step of the cameras: from boards in photographs to lenses, poses and their covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.calibrate.cameras.boards import detect
from services.calibrate.cameras.bundle import BundleFit, fit_bundle
from services.calibrate.cameras.models import MODEL_FOR_OUTLIERS, ModelChoice, choose_lens
from services.calibrate.cameras.second_look import detect_again
from services.calibrate.cameras.sightings import View
from services.calibrate.cameras.start import MIN_CORNERS, first_rig, usable
from services.calibrate.lights.mirror import PosedCamera
from services.calibrate.session.missed import why_missed
from services.calibrate.session.photos import Photos, plain_copies, to_eight_bit
from services.core.errors import CaptureInputError
from services.core.raw.records import RawFrame

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CamerasStep:
    """Calibration of the cameras from boards.

    Attributes:
        names: names of the cameras, in the order of ``raw.toml``.
        fit: lenses, poses and covariance.
        choices: choice of each camera's distortion model, by the camera's name.
        views: the boards that were found, in the order of the fit's corners.
        missed: files in which no board was found, each with the reason.
    """

    names: tuple[str, ...]
    fit: BundleFit
    choices: dict[str, ModelChoice]
    views: tuple[View, ...]
    missed: tuple[tuple[str, str], ...]

    @property
    def posed_cameras(self) -> tuple[PosedCamera, ...]:
        """The calibrated cameras."""
        rig = self.fit.rig
        return tuple(PosedCamera(lens, pose) for lens, pose in zip(rig.lenses, rig.cameras, strict=True))

    @property
    def camera_covariance(self) -> Floats:
        """Covariance (C, C) of the lens values and pose of each camera in turn."""
        layout = self.fit.layout
        columns = np.concatenate(
            [np.concatenate([layout.lens_columns(k), layout.camera_columns(k)]) for k in range(len(self.names))]
        )
        return np.asarray(self.fit.covariance[np.ix_(columns, columns)])

    @property
    def distance_mm(self) -> float:
        """Median distance between cameras and boards."""
        places = self.fit.rig.places[:, 3:]
        centres = np.array([camera.centre_mm for camera in self.posed_cameras])
        return float(np.median(np.linalg.norm(places[:, None] - centres[None], axis=2)))


def calibrate_cameras(photos: Photos) -> CamerasStep:
    """Find all boards, choose each camera's distortion model, and adjust the rig.

    Raises:
        CaptureInputError: there are too few boards, or a camera shares no board with the others.
    """
    folder = photos.folder
    frames = [frame for frame in folder.frame if frame.kind == "board"]
    if not frames:
        raise CaptureInputError("raw.toml lists no frame of kind board; photograph a board in at least ten places.")
    views, missed = boards_in(photos)
    return adjust_cameras(views, {camera.name: camera.size for camera in folder.camera}, _place(frames[0]), missed)


def adjust_cameras(
    views: Sequence[View], sizes: Mapping[str, tuple[int, int]], first: str, missed: tuple[tuple[str, str], ...] = ()
) -> CamerasStep:
    """Choose each camera's distortion model, and adjust the rig to the boards that were found.

    Args:
        views: boards in photographs; the board at place 0 defines the world frame.
        sizes: width and height of the images by the cameras' names, in the order of their numbers.
        first: name of place 0, for messages.
        missed: files in which no board was found, each with the reason.

    Raises:
        CaptureInputError: there are too few boards, or a camera shares no board with the others.
    """
    names, good = tuple(sizes), usable(views)
    if not good and missed:
        file, why = missed[0]
        raise CaptureInputError(f"No board is found in any frame; in {file} {why}.")
    if not any(view.place == 0 for view in good):
        raise CaptureInputError(
            f"No camera shows the board at {first}, the first of raw.toml, which is to be the world's frame; photograph"
            " it again, or list another place first."
        )
    choices = {
        name: choose_lens([view for view in views if view.camera == camera], sizes[name], name)
        for camera, name in enumerate(names)
    }
    good = _renumbered(good)
    start = first_rig(good, [choices[name].lens for name in names], names)
    fit = fit_bundle(good, start, sigma_px=np.array([choices[name].sigma_px for name in names]))
    return CamerasStep(names, fit, choices, tuple(good), missed)


def boards_in(photos: Photos) -> tuple[list[View], tuple[tuple[str, str], ...]]:
    """Find the boards of a folder's photographs.

    A board that is missed is looked for in other copies of its photograph and by second detectors.

    Returns:
        The views, and the files in which no board was found, each with the reason.
    """
    names = [camera.name for camera in photos.folder.camera]
    frames = [frame for frame in photos.folder.frame if frame.kind == "board"]
    boards = {board.name: board for board in photos.folder.board}
    places = list(dict.fromkeys(_place(frame) for frame in frames))
    views, missed = [], []
    for frame in frames:
        grey, board = photos.grey(frame), boards[str(frame.board)]
        image = to_eight_bit(grey)
        found = detect(image, board)
        if len(found.ids) < MIN_CORNERS:
            found = detect_again((image, *plain_copies(grey)), board, MIN_CORNERS) or found
        camera, place = names.index(frame.camera), places.index(_place(frame))
        view = View(camera, place, found.corners_mm, found.pixels, found.ids, frame.file)
        if usable([view]):
            views.append(view)
        else:
            missed.append((frame.file, why_missed(image, board, found)))
    return views, tuple(missed)


def _place(frame: RawFrame) -> str:
    """Return the name of a frame's place; a frame without one is a place of its own, because the board was moved before
    every such photograph.
    """
    return frame.place if frame.place is not None else frame.file


def _renumbered(views: Sequence[View]) -> list[View]:
    """Return the views with places renumbered without gaps; place 0 stays place 0."""
    numbers = sorted({view.place for view in views})
    return [replace(view, place=numbers.index(view.place)) for view in views]


def describe_model(choice: ModelChoice) -> str:
    """Return a phrase that says which distortion model was chosen and why."""
    if not choice.held_out_px:
        return f"{choice.lens.model}, held, as there are too few boards to leave any out"
    errors = ", ".join(f"{name} {value:.3f} px" for name, value in choice.held_out_px.items())
    plain = " (OpenCV's default)" if choice.lens.model == MODEL_FOR_OUTLIERS else ""
    folding = f"; left out, as they fold the image: {', '.join(choice.folding)}" if choice.folding else ""
    return f"{choice.lens.model}{plain}; on boards that were left out: {errors}{folding}"
