"""The faces of a cell: Snell's and Fresnel's laws at medium, glass and air, for smooth plane-parallel layers.

Light that is reflected between the two sides of a glass is summed without interference. Light that a glass's outer side
reflects comes back displaced by twice its thickness times the tangent; the model keeps this displacement, because it
exceeds a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple


class Reflection(NamedTuple):
    """One way in which a face sends light back into the medium."""

    share: float
    shift_mm: float
    """Displacement along the light's lateral direction, mm."""


def fresnel(cosine: float, eta: float) -> float:
    """Unpolarised reflectance for light arriving at ``cosine``, eta = n_beyond / n_before; 1 under total reflection."""
    q2 = (eta - 1) * (eta + 1) + cosine * cosine
    if q2 <= 0:
        return 1.0
    q = math.sqrt(q2)
    s = (cosine - q) / (cosine + q)
    p = (eta * eta * cosine - q) / (eta * eta * cosine + q)
    return 0.5 * (s * s + p * p)


@dataclass(frozen=True)
class Interface:
    """Medium, optional glass and outside. A matched boundary has the same index everywhere."""

    index: float
    index_outside: float = 1.0
    index_glass: float | None = None
    glass_mm: float = 0.0

    def inside_sine(self, angle_deg: float) -> float:
        """Sine of the angle in the medium of light at ``angle_deg`` outside, signed."""
        return self.index_outside * math.sin(math.radians(angle_deg)) / self.index

    def glass_shift_mm(self, inside_sine: float) -> float:
        """Lateral displacement on one way through the glass, mm, signed as the sine."""
        if self.index_glass is None:
            return 0.0
        sine = self.index * inside_sine / self.index_glass
        return self.glass_mm * sine / math.sqrt(1 - sine * sine)

    def transmittance(self, inside_sine: float) -> float:
        """Share of light that passes, the same in both directions."""
        return 1 - sum(reflection.share for reflection in self.reflections(inside_sine))

    def reflections(self, inside_sine: float) -> tuple[Reflection, ...]:
        """Reflections back into the medium for light that arrives from inside: at the glass, then at the glass's outer
        side.

        Light that goes to and fro in the glass more than once, some 1e-4 of the arriving light, is counted with its
        first return.
        """
        cosine = math.sqrt(1 - inside_sine**2)
        if self.index_glass is None:
            return (Reflection(fresnel(cosine, self.index_outside / self.index), 0.0),)
        near = fresnel(cosine, self.index_glass / self.index)
        sine = self.index * inside_sine / self.index_glass
        if abs(sine) >= 1:
            return (Reflection(1.0, 0.0),)
        far = fresnel(math.sqrt(1 - sine * sine), self.index_outside / self.index_glass)
        back = (1 - near) ** 2 * far / (1 - near * far)
        return Reflection(near, 0.0), Reflection(back, 2 * self.glass_shift_mm(inside_sine))
