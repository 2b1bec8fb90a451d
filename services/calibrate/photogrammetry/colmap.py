"""Cameras and poses of a COLMAP model, in millimetres.

A model has no unit of length, so its user gives one: millimetres per unit, or a distance that was measured between two
of its points or images. COLMAP's axes of a camera and its pixel coordinates, with the centre of the first pixel at 0.5,
are those of this project, and its lens models are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from services.core.calibration.cameras_and_lights import DISTORTION_LENGTHS, CalibratedCamera
from services.core.errors import CaptureInputError
from services.core.files.validation import fault_of, first_error
from services.core.installed import require_packages

if TYPE_CHECKING:
    import pycolmap

Floats = NDArray[np.float64]
LENS_MODELS: Mapping[str, int] = MappingProxyType(
    {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8}
)
"""Lens model of COLMAP -> how many of OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6 it has; the others are 0."""
MIN_DISTANCE = 1e-9
"""Smallest distance between two points of a model, in its unit, by which it can be scaled."""


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance between two things of a model: numbers of 3D points, or names of images."""

    first: str
    second: str
    distance_mm: float


class ColmapModel:
    """A COLMAP model, as text (cameras.txt, images.txt, points3D.txt) or binary (.bin)."""

    def __init__(self, folder: Path) -> None:
        """Read the model.

        Raises:
            CaptureInputError: the folder holds no model, or one that cannot be read. PlatformError: pycolmap is not
                installed.
        """
        require_packages(("pycolmap",), "colmap")
        import pycolmap

        self.folder = folder
        found = [kind for kind in ("bin", "txt") if (folder / f"cameras.{kind}").is_file()]
        if not found:
            raise CaptureInputError(
                f"{folder} holds neither cameras.bin nor cameras.txt; name the folder of a COLMAP model, such as"
                " sparse/0."
            )
        try:
            self._model = pycolmap.Reconstruction()
            (self._model.read_binary if found[0] == "bin" else self._model.read_text)(str(folder))
        except (ValueError, IndexError, RuntimeError, MemoryError) as problem:
            why = self._unknown_lens(found[0]) or f"pycolmap says: {str(problem).strip()}"
            raise CaptureInputError(
                f"The COLMAP model in {folder} cannot be read ({why}); export it again."
            ) from problem

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images that have a pose, by their numbers in COLMAP."""
        return tuple(self._model.images[number].name for number in sorted(self._model.reg_image_ids()))

    def mm_per_unit(self, known: KnownDistance) -> float:
        """Scale of the model by a distance that was measured.

        Raises:
            CaptureInputError: the model lacks one of the two things, or they lie at one place.
        """
        first, second = self._place(known.first), self._place(known.second)
        distance = float(np.linalg.norm(first - second))
        if not distance > MIN_DISTANCE:
            raise CaptureInputError(
                f"{known.first} and {known.second} lie at one place in {self.folder}; measure between two others."
            )
        return known.distance_mm / distance

    @property
    def distance(self) -> float:
        """Median distance between the model's points and the centres of its images, in its unit.

        Raises:
            CaptureInputError: the model has no points.
        """
        points = np.array([point.xyz for point in self._model.points3D.values()]).reshape(-1, 3)
        if len(points) == 0:
            raise CaptureInputError(f"The model in {self.folder} has no 3D points; export it with points3D.")
        centres = [self._image(image).projection_center() for image in self.images]
        return float(np.median([np.linalg.norm(points - centre, axis=-1) for centre in centres]))

    def camera(self, image: str, name: str, mm_per_unit: float) -> CalibratedCamera:
        """The camera that took an image, with the pose that it had then.

        Args:
            image: name of the image in the model.
            name: name of the camera.
            mm_per_unit: length of the model's unit, mm.

        Raises:
            CaptureInputError: the model has no such image, or its lens model has no counterpart here.
        """
        taken = self._image(image)
        camera = self._model.cameras[taken.camera_id]
        if camera.model_name not in LENS_MODELS:
            raise CaptureInputError(
                f"Image {image} of {self.folder} has COLMAP's lens model {camera.model_name}, and only"
                f" {', '.join(LENS_MODELS)} can be used; undistort the images by COLMAP's image_undistorter, or choose"
                " one of these in its feature_extractor."
            )
        coefficients = camera.params.tolist()[len(camera.params) - LENS_MODELS[camera.model_name] :]
        if coefficients:
            coefficients += [0.0] * (min(DISTORTION_LENGTHS) - len(coefficients))
        pose = np.eye(4)
        pose[:3] = taken.cam_from_world().matrix()
        pose[:3, 3] *= mm_per_unit
        fields = {
            "name": name,
            "size": (camera.width, camera.height),
            "K": [
                [camera.focal_length_x, 0.0, camera.principal_point_x],
                [0.0, camera.focal_length_y, camera.principal_point_y],
                [0.0, 0.0, 1.0],
            ],
            "distortion": coefficients or None,
            "camera_from_world": pose.tolist(),
        }
        try:
            return CalibratedCamera.model_validate(fields)
        except ValidationError as problem:
            fault = fault_of(first_error(problem), CalibratedCamera)
            raise CaptureInputError(f"Image {image} of {self.folder}: {fault}.") from problem

    def _image(self, name: str) -> pycolmap.Image:
        found = self._model.find_image_with_name(name)
        if found is None or not found.has_pose:
            listed = ", ".join(self.images[:3]) or "no image with a pose"
            raise CaptureInputError(f"The model in {self.folder} has no pose of image {name}; it has {listed}.")
        return found

    def _place(self, what: str) -> Floats:
        """Place (3,), in the model's unit, of an image's centre or of a 3D point."""
        if what not in self.images and what.isascii() and what.isdigit():
            if not self._model.exists_point3D(int(what)):
                raise CaptureInputError(
                    f"The model in {self.folder} has no 3D point {what}; choose one of its points, or an image's name."
                )
            return np.asarray(self._model.points3D[int(what)].xyz, dtype=np.float64)
        return np.asarray(self._image(what).projection_center(), dtype=np.float64)

    def _unknown_lens(self, kind: str) -> str | None:
        """In words, the first lens model of cameras.txt that COLMAP does not have; None where all are known."""
        import pycolmap

        if kind != "txt":
            return None
        lines = (self.folder / "cameras.txt").read_text(errors="replace").splitlines()
        named = [line.split()[1] for line in lines if not line.startswith("#") and len(line.split()) > 1]
        unknown = next((name for name in named if name not in pycolmap.CameraModelId.__members__), None)
        return None if unknown is None else f"COLMAP has no lens model {unknown}"


def named_images(images: Sequence[str], chosen: Sequence[str] = ()) -> dict[str, str]:
    """Names of cameras and the images of a model that they took, one image a camera.

    Args:
        images: names of the model's images.
        chosen: ``CAMERA=IMAGE`` each; empty for all images, by their names without folder and ending.

    Raises:
        CaptureInputError: an entry is not CAMERA=IMAGE, or two images would be of one camera.
    """
    found: dict[str, str] = {}
    for entry in chosen or tuple(f"{PurePosixPath(image).stem}={image}" for image in images):
        name, _, image = entry.partition("=")
        if not name or not image:
            raise CaptureInputError(f"--camera {entry} is not CAMERA=IMAGE; give such as left=left_0001.jpg.")
        if name in found:
            raise CaptureInputError(
                f"Images {found[name]} and {image} would both be of camera {name}; name them by --camera CAMERA=IMAGE."
            )
        found[name] = image
    return found
