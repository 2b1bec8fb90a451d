"""An average dental arch by FDI number: position and axes of each tooth, and the rotation of a measured arch to it.

Arch frame: x along the front teeth, y to the front, z occlusal; x is the patient's left in an upper jaw and the right
in a lower one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NOMINAL_MM = np.array(
    [(4.2, 0.0), (11.6, -2.0), (18.0, -6.5), (22.0, -12.5), (24.5, -19.5), (27.0, -28.0), (29.5, -37.5), (31.0, -47.0)]
)
"""Middles (8, 2) of the teeth 1 to 8 of a quadrant, x and y in mm; they only need to distinguish front from back and
left from right."""
UPPER = (1, 2, 5, 6)
"""Quadrants of the upper jaw."""


def is_upper(fdi: int) -> bool:
    """Whether the tooth is one of the upper jaw."""
    return fdi // 10 in UPPER


def side_of_front(fdi: int) -> int:
    """Sign of a tooth's side along x = y × z of the arch frame.

    Upper teeth point down and lower ones up, so x is the patient's left in the upper jaw and right in the lower jaw.
    """
    return 1 if fdi // 10 % 2 == 0 else -1


def nominal_positions(teeth: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles (N, 3) in mm and canonical axes (N, 3, 3) of the given teeth in an average arch.

    The rows of the axes are x = y × z, y buccal and z occlusal.
    """
    line = np.concatenate([NOMINAL_MM[::-1] * (-1, 1), NOMINAL_MM])
    steps = np.gradient(line, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    indices = np.array(
        [len(NOMINAL_MM) + (number % 10 - 1 if side_of_front(number) > 0 else -(number % 10)) for number in teeth]
    )
    axes = np.zeros((len(teeth), 3, 3))
    axes[:, 0, :2] = steps[indices]
    axes[:, 1, :2] = np.stack([-steps[indices, 1], steps[indices, 0]], axis=-1)
    axes[:, 2, 2] = 1.0
    return np.concatenate([line[indices], np.zeros((len(teeth), 1))], axis=1), axes


def arch_from_middles(teeth: tuple[int, ...], middles_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) into the arch frame that brings middles (N, 3) nearest to an average arch's (Kabsch 1976).

    Middles in a line do not determine the rotation about it, which is then arbitrary.
    """
    nominal, _ = nominal_positions(teeth)
    left, _, right = np.linalg.svd((nominal - nominal.mean(axis=0)).T @ (middles_mm - middles_mm.mean(axis=0)))
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right)
