"""Manual masks, decoded for the images to which they belong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.files.mask_images import require_mask_png
from services.core.masks import ALL_LIGHTS, digest_of, mask_path, read_masks
from services.core.records import FolderCapture, MaskBit


class HandMasks:
    """Manual masks of a job, as they were when this object was made."""

    def __init__(self, root: Path, description: FolderCapture) -> None:
        """Read the masks.

        Args:
            root: folder of the job.
            description: cameras and lights of the capture.

        Raises:
            CaptureInputError: a mask belongs to no camera or light of the capture.
        """
        self._root, self._masks = root, read_masks(root)
        self.digest = digest_of(self._masks)
        cameras, lights = (
            {camera.name for camera in description.cameras},
            {light.name for light in description.lights} | {ALL_LIGHTS},
        )
        for camera, light in self._masks:
            if camera not in cameras or light not in lights:
                raise CaptureInputError(
                    f"Mask {mask_path(root, camera, light)} is of no camera and light of the capture; remove it or"
                    " correct its name."
                )

    def bits(self, camera: str, light: str, size: tuple[int, int]) -> NDArray[np.uint16]:
        """Mask bits (H, W): MANUAL where the mask of this light or the one for all lights is set, else 0.

        Args:
            camera: name of the camera. light: name of the light.
            size: (width, height) of the camera's image.

        Raises:
            CaptureInputError: a mask is not an image of this size.
        """
        bits = np.zeros(size[::-1], dtype=np.uint16)
        for of in ((camera, light), (camera, ALL_LIGHTS)):
            if (content := self._masks.get(of)) is not None:
                bits[self._excluded(mask_path(self._root, *of), content, size)] = MaskBit.MANUAL
        return bits

    def _excluded(self, path: Path, content: bytes, size: tuple[int, int]) -> NDArray[np.bool_]:
        try:
            return _pixels(content, size)
        except ValueError as problem:
            raise CaptureInputError(
                f"Mask {path} is no image of {size[0]} x {size[1]} pixels in plain grey: {problem}; save it with 0"
                " where the fit may use the pixel and 255 elsewhere, or remove it."
            ) from problem


def _pixels(content: bytes, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels (H, W) that a mask excludes.

    Raises:
        ValueError: the content is no mask of this size.
    """
    import cv2

    require_mask_png(content, size)
    values = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.shape != size[::-1]:
        raise ValueError("its pixels cannot be read")
    return np.asarray(values > 0)
