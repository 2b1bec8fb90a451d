"""Transform from a camera's channels to XYZ: a 3 × 3 matrix or a root polynomial, whichever has the smaller error on
held-out patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.colours import root_terms
from services.core.colour.cie import D50, delta_e_2000, lab_from_xyz
from services.core.errors import CaptureInputError

Floats = NDArray[np.float64]
MIN_PATCHES = 12
"""Smallest number of patches for a fit: twice the six terms of a root polynomial, so that leave-one-out
cross-validation is still meaningful."""


@dataclass(frozen=True)
class ColourFit:
    """Colours of one camera.

    Attributes:
        matrix: XYZ from RGB (3, 3).
        root_polynomial: coefficients (3, 6) of r, g, b, √(rg), √(gb), √(rb); None where the matrix is as good.
        held_out: ΔE2000 (N,) of every patch, by a fit of the chosen model to the other patches.
        held_out_by_model: mean of that ΔE2000 over the patches, by model.
        fitted: ΔE2000 (N,) of every patch by the fit to all patches.
        residuals: XYZ of the fit to all patches minus the reference (N, 3).
    """

    matrix: Floats
    root_polynomial: Floats | None
    held_out: Floats
    held_out_by_model: dict[str, float]
    fitted: Floats
    residuals: Floats

    def xyz(self, rgb: Floats) -> Floats:
        """Return the XYZ (N, 3) of channels (N, 3), with Y = 1 for a perfect diffuser."""
        if self.root_polynomial is None:
            return np.asarray(rgb @ self.matrix.T)
        return np.asarray(root_terms(rgb) @ self.root_polynomial.T)


def least_squares_matrix(terms: Floats, xyz: Floats) -> Floats:
    """Return the matrix (3, T) that maps terms (N, T) to XYZ (N, 3) with least squared errors."""
    return np.asarray(np.linalg.lstsq(terms, xyz, rcond=None)[0].T)


def fit_colour(rgb: Floats, xyz: Floats, camera: str, white: Floats = D50) -> ColourFit:
    """Fit a camera's colours to patches.

    A root polynomial has twice the coefficients, so it is chosen only where its mean error on held-out patches is
    smaller by more than the standard error of the difference.

    Args:
        rgb: patch means (N, 3), radiance divided by that of a perfect diffuser in the same light.
        xyz: reference XYZ of the same patches (N, 3), Y = 1 for a perfect diffuser.
        camera: name of the camera, for messages.
        white: XYZ of the illuminant of ``xyz``.

    Raises:
        CaptureInputError: there are fewer than ``MIN_PATCHES`` patches.
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
    fitted_xyz = models[chosen] @ (matrix if roots is None else roots).T
    return ColourFit(
        matrix=matrix,
        root_polynomial=roots,
        held_out=left_out[chosen],
        held_out_by_model={name: float(one.mean()) for name, one in left_out.items()},
        fitted=delta_e_2000(lab_from_xyz(fitted_xyz, white), target),
        residuals=fitted_xyz - xyz,
    )


def _left_out(terms: Floats, xyz: Floats) -> Floats:
    """Return each patch's XYZ by a fit to all other patches (N, 3): in linear least squares, leaving a row out
    multiplies its residual by 1 ÷ (1 − leverage).
    """
    hat = terms @ np.linalg.pinv(terms)
    residuals = xyz - hat @ xyz
    return np.asarray(xyz - residuals / (1 - np.diag(hat))[:, None])
