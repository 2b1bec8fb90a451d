"""Motion of the jaws in one camera's view over the frames of a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.records import FrameRecord
from services.preprocess.projection import Footprint
from services.preprocess.stabilise import TERMS, Aligner, FloatArray, SurfaceFlow, interpolate

Image = NDArray[np.float32]
# Beyond this share of a jaw's shorter side the coarse-to-fine alignment may lock on to the wrong edge
LIMIT_OF_EXTENT = 1 / 6
STORED_PIXELS = 250_000
BAND_ROWS = 256


def stored_step(shape: tuple[int, int]) -> int:
    """Displacements are stored at every so many pixels: the field is smooth."""
    return int(np.ceil(np.sqrt(shape[0] * shape[1] / STORED_PIXELS)))


def jaws(fdi: Sequence[int]) -> list[list[int]]:
    """Positions of the upper and of the lower teeth in a list of FDI numbers; each jaw moves as one body."""
    upper = [k for k, number in enumerate(fdi) if number // 10 in {1, 2, 5, 6}]
    return [group for group in (upper, [k for k in range(len(fdi)) if k not in upper]) if group]


@dataclass(frozen=True)
class Displacement:
    """Where the reference's pixels are in one frame.

    Attributes:
        coefficients: (bodies, TERMS, 2).
        median_px: median length over the teeth.
        error_px: estimated error of its interpolation in time.
    """

    coefficients: FloatArray
    median_px: float
    error_px: float


class ViewMotion:
    """Measures motion against the first frame and gives it for every light frame.

    Between tracking frames, which share one light, it is measured and then interpolated over the frame number: frames are triggered evenly,
    and the number is free of the host's clock. With fewer than two of them every light frame is matched to the first by its edges.
    """

    def __init__(
        self,
        footprint: Footprint,
        bodies: Sequence[Sequence[int]],
        frames: Sequence[FrameRecord],
        brightness: Callable[[FrameRecord], Image],
        view: str,
    ) -> None:
        """Measure.

        Args:
            bodies: the footprint's mesh numbers of each rigid body.
            brightness: (H, W) linear image of a frame; called once per frame used.
            view: name of the camera, for messages.

        Raises:
            CaptureInputError: moved too far to be aligned; names the frame and the camera.
        """
        tracking = [frame for frame in frames if frame.kind == "tracking"]
        self._interpolated = len(tracking) >= 2
        used = tracking if self._interpolated else [frame for frame in frames if frame.kind == "light"]
        self._shape = footprint.mesh.shape
        self._bodies = [body for body in (SurfaceFlow(footprint, meshes) for meshes in bodies) if body.seen.any()]
        self._step = stored_step(footprint.mesh.shape)

        reference = brightness(used[0])
        aligners = [Aligner(body, reference, "texture" if self._interpolated else "edges") for body in self._bodies]
        knots = [np.zeros((len(self._bodies), TERMS, 2))]
        for frame in used[1:]:
            image = brightness(frame)
            knots.append(np.asarray([aligner.solve(image) for aligner in aligners]).reshape(-1, TERMS, 2))
            for body, coefficients in zip(self._bodies, knots[-1], strict=True):
                moved, limit = self._median(body, coefficients), LIMIT_OF_EXTENT * body.extent_px
                if moved > limit:
                    raise CaptureInputError(
                        f"The subject moved {moved:.1f} px by frame {frame.index} (camera {view}, light {frame.light or 'all'}), more than the "
                        f"{limit:.1f} px that can be aligned; capture again with the head supported."
                    )
        self._index = np.array([frame.index for frame in used], dtype=np.float64)
        self._knots: FloatArray = np.asarray(knots)

    def at(self, frame: FrameRecord) -> Displacement:
        """Motion of one frame."""
        if self._interpolated:
            coefficients, error = interpolate(self._index, self._knots, float(frame.index))
        else:
            coefficients = self._knots[int(np.flatnonzero(self._index == frame.index)[0])]
            error = np.zeros_like(coefficients)
        medians = [self._median(body, c) for body, c in zip(self._bodies, coefficients, strict=True)]
        # The shift's error stands for the field's: the other terms are small beside it
        return Displacement(
            coefficients, max(medians, default=0.0), float(np.linalg.norm(error[:, 0], axis=-1).max(initial=0.0))
        )

    def field(self, displacement: Displacement, step: int = 1) -> Image:
        """Displacement (H, W, 2) in pixels at every ``step``-th pixel; pixels beside all teeth move with the first jaw."""
        height, width = self._shape
        field = np.zeros((-(-height // step), -(-width // step), 2), dtype=np.float32)
        for number, (body, coefficients) in enumerate(zip(self._bodies, displacement.coefficients, strict=True)):
            # Bands of rows, since the basis has several times the size of the field
            for top in range(0, height, BAND_ROWS * step):
                rows = slice(top, min(top + BAND_ROWS * step, height))
                own = body.field(coefficients, rows, step)
                target = field[top // step : top // step + len(own)]
                target[:] = own if number == 0 else np.where(body.seen[rows][::step, ::step, None], own, target)
        return field

    def stored(self, displacement: Displacement) -> Image:
        """Displacement at every ``stored_step``-th pixel."""
        return self.field(displacement, self._step)

    def _median(self, body: SurfaceFlow, coefficients: FloatArray) -> float:
        lengths = np.linalg.norm(body.field(coefficients, step=self._step), axis=-1)
        seen = body.seen[:: self._step, :: self._step]
        return float(np.median(lengths[seen])) if seen.any() else 0.0
