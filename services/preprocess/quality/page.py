"""HTML page about a prepared capture: motion, coverage, levels, noise, and every image with its masked pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.core.pages.page import page_template
from services.core.store import write_atomic
from services.preprocess.quality.images import STOPS, CameraFlow, ImageQuality

TEMPLATE = Path(__file__).parent / "page.html.j2"
WIDTH, HEIGHT = 320, 120
"""Width and height of a chart on the page, pixels."""


@dataclass(frozen=True)
class CameraPage:
    """Content of the page for one camera.

    Attributes:
        name: name of the camera.
        images: quality of the camera's images.
        motion: for each image the light, the displacement removed, its standard error, pixels, and what they are known
            from; None where unknown.
        coverage: for each tooth the FDI number and, for each image, its valid pixels as a share of those in the image
            that shows most of it.
        levels: for each stop below an image's brightest pixel the share of all tooth pixels, and the bar's height in
            pixels.
        flow: optical flow before and after stabilisation; None where no two frames share their light.
        noise: points of an SVG polyline, relative noise by stop.
        most_noise: largest relative noise, per cent.
    """

    name: str
    images: tuple[ImageQuality, ...]
    motion: tuple[tuple[str, float | None, float | None, str | None], ...]
    coverage: tuple[tuple[int, tuple[float, ...]], ...]
    levels: tuple[tuple[float, float], ...]
    flow: CameraFlow | None
    noise: str
    most_noise: float


def write_page(folder: Path, images: Sequence[ImageQuality], flows: Sequence[CameraFlow], notes: Sequence[str]) -> None:
    """Write ``quality/index.html`` beside the pictures.

    Args:
        folder: folder of the stage.
        images: quality of all images of the capture.
        flows: optical flow of the cameras whose motion was measured under one light; their pictures are in
            ``quality/flow``.
        notes: sentences the operator should read first.
    """
    flow_of = {flow.camera: flow for flow in flows}
    cameras = [_page_of(name, images, flow_of.get(name)) for name in dict.fromkeys(image.camera for image in images)]
    text = page_template(TEMPLATE).render(cameras=cameras, notes=notes, width=WIDTH, height=HEIGHT, stops=STOPS)
    write_atomic(folder / "quality" / "index.html", text.encode())


def _page_of(name: str, images: Sequence[ImageQuality], flow: CameraFlow | None) -> CameraPage:
    own = tuple(image for image in images if image.camera == name)
    levels = np.sum([image.levels for image in own], axis=0, dtype=float)
    share = levels / max(levels.sum(), 1)
    noise = [_median([image.noise[stop] for image in own]) for stop in range(STOPS)]
    most = max((value for value in noise if value is not None), default=0.0)
    points = " ".join(
        f"{(stop + 0.5) * WIDTH / STOPS:.1f},{HEIGHT * (1 - value / most):.1f}"
        for stop, value in enumerate(noise)
        if value is not None and most > 0
    )
    return CameraPage(
        name=name,
        images=own,
        motion=tuple((image.light, image.motion_px, image.motion_error_px, image.motion_source) for image in own),
        coverage=tuple((fdi, _coverage(own, fdi)) for fdi in own[0].valid_by_tooth),
        flow=flow,
        levels=tuple((float(one), float(HEIGHT * one / max(share.max(), 1e-9))) for one in share),
        noise=points,
        most_noise=100 * most,
    )


def _coverage(images: Sequence[ImageQuality], fdi: int) -> tuple[float, ...]:
    counts = [image.valid_by_tooth[fdi] for image in images]
    return tuple(count / max(*counts, 1) for count in counts)


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
