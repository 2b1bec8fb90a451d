"""Neighbours of a jaw's teeth, and so the coordinates that act on each pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.average_arch import is_upper
from services.fit.coordinates.domain import Domain
from services.fit.measurements.blocks import PixelParts

COLOURS = 3
"""Number of colours of the teeth. Between two teeth of one colour there are at least two others, so each pixel can be
assigned to the one tooth of a colour that affects it."""


@dataclass(frozen=True)
class Neighbours:
    """Positions of the teeth in the scene, in the order in which they stand along the arch, one jaw after the other."""

    order: tuple[int, ...]

    @staticmethod
    def of(fdi: Sequence[int]) -> Neighbours:
        """Neighbours of teeth by their FDI numbers."""
        return Neighbours(tuple(sorted(range(len(fdi)), key=lambda k: (is_upper(fdi[k]), arch_position(fdi[k])))))

    def colour(self, tooth: int) -> int:
        """Colour of a tooth, from 0 to ``COLOURS`` - 1, in turn along the arch."""
        return self.order.index(tooth) % COLOURS

    def beside(self, tooth: int) -> tuple[int, ...]:
        """Positions of a tooth and its one or two neighbours: the teeth that are nearer to it than to any other tooth
        of its colour.
        """
        position = self.order.index(tooth)
        return self.order[max(position - 1, 0) : position + 2]

    def pixels(self, tooth: int, parts: PixelParts) -> NDArray[np.bool_]:
        """Mask (N,) of the pixels that show a tooth or its neighbours, or gums and wall nearest to them."""
        return np.isin(parts.tooth, self.beside(tooth))

    def near(self, domain: Domain) -> tuple[tuple[int, ...], ...]:
        """For each tooth, the indices of the coordinates of itself, of its neighbours, and of parts that belong to no
        single tooth.
        """
        found = []
        for tooth in range(len(self.order)):
            teeth = {None, *self.beside(tooth)}
            found.append(tuple(n for n, coordinate in enumerate(domain.coordinates) if coordinate.tooth in teeth))
        return tuple(found)


def arch_position(fdi: int) -> int:
    """Signed place along the arch from the midline: negative for the patient's right (quadrants 1, 4 and milk teeth's
    5, 8), positive for the left.
    """
    quadrant, position = divmod(fdi, 10)
    return -position if quadrant in {1, 4, 5, 8} else position
