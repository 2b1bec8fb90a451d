"""Progress reports of a running preparation."""

from __future__ import annotations

import numpy as np

from services.core.stage import StageContext, StageEvent
from services.preprocess.tasks.records import ImageDone

ENOUGH = 3
"""Smallest number of finished images from which the remaining time is estimated; the first ones also load libraries."""
LIKELY = (0.1, 0.9)
"""Quantiles of the time per image from which the lower and upper remaining times are estimated."""


class Progress:
    """Reporter of each finished image and of a range for the remaining time.

    Args:
        images: number of images of the whole capture. cameras: number of cameras.
    """

    def __init__(self, context: StageContext, images: int, cameras: int) -> None:
        self._context, self._images, self._left, self._threads = context, images, images, 1
        self._seconds: list[float] = []
        self._tell("started", f"{images} images of {cameras} cameras.")

    def begin(self, missing: int, threads: int) -> None:
        """Begin with ``missing`` images to make, ``threads`` of them at once."""
        self._left, self._threads = missing, threads
        if missing < self._images:
            self._tell("log", f"{self._images - missing} of {self._images} images are prepared already.")

    def tell(self, done: ImageDone) -> None:
        """Report one more stored image."""
        self._left -= 1
        self._seconds.append(done.seconds)
        quality, share = done.quality, 1 - self._left / self._images
        message = f"Camera {quality.camera}, light {quality.light}: {quality.valid_pixels} valid pixels."
        data, left_s = quality.model_dump(), self._left_s()
        if left_s is not None:
            data["left_s"] = left_s
            message += f" {_in_words(*left_s)} left."
        self._context.report(StageEvent(stage="prepare", kind="progress", message=message, done=share, data=data))
        if quality.valid_pixels == 0:
            reasons = ", ".join(
                f"{name} {part:.0%}" for name, part in sorted(quality.masked.items(), key=lambda item: -item[1])
            )
            self._tell("log", f"Camera {quality.camera}, light {quality.light} has no valid pixel left ({reasons}).")

    def shade(self, cameras: int) -> None:
        """Report that shadows are searched in the images of this number of cameras."""
        self._tell("log", f"Shadows are looked for in the images of {cameras} cameras.")

    def finish(self) -> None:
        """Report that the store is published."""
        message = f"{self._images} images are prepared."
        self._context.report(StageEvent(stage="prepare", kind="finished", message=message, done=1.0))

    def _left_s(self) -> tuple[float, float] | None:
        """Lower and upper estimate of the remaining time in seconds; None while too few images are finished.

        They assume that each remaining image takes as long as the lower or upper ``LIKELY`` quantile so far.
        """
        if len(self._seconds) < ENOUGH or not self._left:
            return None
        rounds = -(-self._left // self._threads)
        low, high = (float(rounds * np.quantile(self._seconds, share)) for share in LIKELY)
        return round(low, 1), round(high, 1)

    def _tell(self, kind: str, message: str) -> None:
        self._context.report(StageEvent.model_validate({"stage": "prepare", "kind": kind, "message": message}))


def _in_words(low_s: float, high_s: float) -> str:
    if high_s < 90:
        return f"{low_s:.0f} to {max(high_s, 1):.0f} s"
    return f"{low_s / 60:.0f} to {high_s / 60:.0f} min"
