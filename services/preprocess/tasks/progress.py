"""Progress reports of a running preparation."""

from __future__ import annotations

import numpy as np

from services.core.stage import StageContext, StageEvent
from services.preprocess.tasks.records import ImageDone

MIN_IMAGES = 3
"""Smallest number of finished images from which the remaining time is estimated; the first ones also load libraries."""
TIME_QUANTILES = (0.1, 0.9)
"""Quantiles of the time per image from which the lower and upper remaining times are estimated."""


class Progress:
    """Reporter of each finished image and of a range for the remaining time.

    Args:
        images: number of images of the whole capture. cameras: number of cameras.
    """

    def __init__(self, context: StageContext, images: int, cameras: int) -> None:
        self._context, self._images, self._remaining, self._threads = context, images, images, 1
        self._seconds: list[float] = []
        self._report("started", f"{images} images of {cameras} cameras.")

    def begin(self, missing: int, threads: int) -> None:
        """Begin with ``missing`` images to make, ``threads`` of them at once."""
        self._remaining, self._threads = missing, threads
        if missing < self._images:
            self._report("log", f"{self._images - missing} of {self._images} images are prepared already.")

    def report_image(self, done: ImageDone) -> None:
        """Report one more stored image."""
        self._remaining -= 1
        self._seconds.append(done.seconds)
        quality, share = done.quality, 1 - self._remaining / self._images
        message = f"Camera {quality.camera}, light {quality.light}: {quality.valid_pixels} valid pixels."
        data, remaining_s = quality.model_dump(), self._remaining_s()
        if remaining_s is not None:
            data["left_s"] = remaining_s
            message += f" {_in_words(*remaining_s)} left."
        self._context.report(StageEvent(stage="prepare", kind="progress", message=message, done=share, data=data))
        if quality.valid_pixels == 0:
            reasons = ", ".join(
                f"{name} {part:.0%}" for name, part in sorted(quality.masked.items(), key=lambda item: -item[1])
            )
            self._report("log", f"Camera {quality.camera}, light {quality.light} has no valid pixel left ({reasons}).")

    def begin_shading(self, cameras: int) -> None:
        """Report that shadows are searched in the images of this number of cameras."""
        self._report("log", f"Shadows are looked for in the images of {cameras} cameras.")

    def finish(self) -> None:
        """Report that the store is published."""
        message = f"{self._images} images are prepared."
        self._context.report(StageEvent(stage="prepare", kind="finished", message=message, done=1.0))

    def _remaining_s(self) -> tuple[float, float] | None:
        """Lower and upper estimate of the remaining time in seconds; None while too few images are finished.

        They assume that each remaining image takes as long as the lower or upper ``TIME_QUANTILES`` quantile so far.
        """
        if len(self._seconds) < MIN_IMAGES or not self._remaining:
            return None
        rounds = -(-self._remaining // self._threads)
        low, high = (float(rounds * np.quantile(self._seconds, share)) for share in TIME_QUANTILES)
        return round(low, 1), round(high, 1)

    def _report(self, kind: str, message: str) -> None:
        self._context.report(StageEvent.model_validate({"stage": "prepare", "kind": kind, "message": message}))


def _in_words(low_s: float, high_s: float) -> str:
    if high_s < 90:
        return f"{low_s:.0f} to {max(high_s, 1):.0f} s"
    return f"{low_s / 60:.0f} to {high_s / 60:.0f} min"
