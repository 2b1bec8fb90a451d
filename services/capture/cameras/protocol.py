"""Protocol of the cameras that a capture uses."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray


class Cameras(Protocol):
    """All cameras of a rig on one trigger line.

    Counts become scene radiance by ``(count - black_level) * radiance_per_count / (level * exposure_s)``, with
    ``level`` the fraction of full scale of the light that was on: the radiance that the light would cause at
    ``Light.intensity``, which holds at level 1.
    """

    @property
    def bits(self) -> int:
        """Resolution of the converter; counts reach 2**bits - 1."""

    @property
    def black_level(self) -> int:
        """Counts without light."""

    @property
    def radiance_per_count(self) -> float:
        """Scene radiance of one count above black at level 1 and 1 s exposure."""

    def arm(self, exposure_s: float, frame: int) -> None:
        """Prepare for one trigger; ``frame`` is the exposure's number in the plan."""

    def read(self) -> tuple[NDArray[np.uint16], ...]:
        """Wait for the exposure to end and return the counts (height, width, channel) of each camera.

        Raises:
            RigError: no trigger arrived, or a camera does not answer.
        """

    def __enter__(self) -> Self:
        """Open the cameras."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the cameras."""
