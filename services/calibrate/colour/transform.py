"""A camera's channels to XYZ: a 3 × 3 matrix or a root polynomial, whichever draws patches better that it has not
seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.calibrate.colour.cie import D50, delta_e_2000, lab_from_xyz
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
MIN_PATCHES = 12
"""A root polynomial has six terms; with twice as many patches leaving one out still tells."""


@dataclass(frozen=True)
class ColourFit:
    """Colours of one camera.

    Attributes:
        matrix: XYZ from RGB (3, 3).
        root_polynomial: (3, 6) on r, g, b, √(rg), √(gb), √(rb); None where the matrix does as well.
        held_out: ΔE2000 of every patch by a fit to the others (N,), of what was chosen.
        held_out_by_model: its mean by model.
        fitted: ΔE2000 of every patch by the fit to all (N,).
        residuals: XYZ of the fit to all minus the reference (N, 3).
    """

    matrix: Floats
    root_polynomial: Floats | None
    held_out: Floats
    held_out_by_model: dict[str, float]
    fitted: Floats
    residuals: Floats

    def xyz(self, rgb: Floats) -> Floats:
        """XYZ (N, 3) of channels (N, 3), with Y = 1 for a perfect diffuser."""
        if self.root_polynomial is None:
            return np.asarray(rgb @ self.matrix.T)
        return np.asarray(root_terms(rgb) @ self.root_polynomial.T)


def root_terms(rgb: Floats) -> Floats:
    """Terms of degree 2 (N, 6), which double where the light doubles (Finlayson, Mackiewicz & Hurlbert 2015, table
    I).
    """
    r, g, b = np.maximum(rgb, 0).T
    return np.stack([r, g, b, np.sqrt(r * g), np.sqrt(g * b), np.sqrt(r * b)], axis=1)


def least_squares_matrix(terms: Floats, xyz: Floats) -> Floats:
    """The matrix (3, T) that takes terms (N, T) to XYZ (N, 3) with least squared errors."""
    return np.asarray(np.linalg.lstsq(terms, xyz, rcond=None)[0].T)


def fit_colour(rgb: Floats, xyz: Floats, camera: str, white: Floats = D50) -> ColourFit:
    """Fit a camera's colours to patches.

    A root polynomial has twice the coefficients, so it is taken only where it draws patches that were left out better
    by more than the standard error of the difference.

    Args:
        rgb: patch means (N, 3), radiance over that of a perfect diffuser in the same light.
        xyz: of the same patches (N, 3), Y = 1 for a perfect diffuser.
        camera: its name, for messages.
        white: XYZ of the light that ``xyz`` is under.

    Raises:
        CaptureInputError: too few patches, or colours that do not depend on the channels.
    """
    if len(rgb) < MIN_PATCHES:
        raise CaptureInputError(
            f"Camera {camera} shows {len(rgb)} patches of the chart that are not saturated, and {MIN_PATCHES} are"
            " needed; expose it less."
        )
    models = {"matrix": np.asarray(rgb), "root polynomial": root_terms(rgb)}
    target = lab_from_xyz(xyz, white)
    left_out = {
        name: delta_e_2000(lab_from_xyz(_left_out(terms, xyz), white), target) for name, terms in models.items()
    }
    gain = left_out["matrix"] - left_out["root polynomial"]
    takes_roots = gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain))
    chosen = "root polynomial" if takes_roots else "matrix"
    matrix = least_squares_matrix(models["matrix"], xyz)
    roots = least_squares_matrix(models["root polynomial"], xyz) if takes_roots else None
    drawn = models[chosen] @ (matrix if roots is None else roots).T
    return ColourFit(
        matrix=matrix,
        root_polynomial=roots,
        held_out=left_out[chosen],
        held_out_by_model={name: float(one.mean()) for name, one in left_out.items()},
        fitted=delta_e_2000(lab_from_xyz(drawn, white), target),
        residuals=drawn - xyz,
    )


def _left_out(terms: Floats, xyz: Floats) -> Floats:
    """Each patch's XYZ by a fit to all others (N, 3): residuals of linear least squares grow by 1 ÷ (1 − leverage)."""
    hat = terms @ np.linalg.pinv(terms)
    residuals = xyz - hat @ xyz
    return np.asarray(xyz - residuals / (1 - np.diag(hat))[:, None])
