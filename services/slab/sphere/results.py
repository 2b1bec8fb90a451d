"""Results of one wavelength, and the sentences about them."""

from __future__ import annotations

from pydantic import Field

from services.core.geometry import Record
from services.slab.results.result import SlabUnit
from services.slab.solve.uncertainty import LARGEST_COEFFICIENT_SHARE


class SphereQuantity(Record):
    """A measured number; value and standard error are null where the readings leave it open."""

    value: float | None
    se: float | None = Field(description="standard error")
    unit: SlabUnit
    determined: bool = Field(description="whether the readings fix it")


class OtherSlab(Record):
    """Another slab of the same cell that reads the same."""

    sigma_a: float
    sigma_s_reduced: float
    g: float


class SphereFit(Record):
    """Result of one wavelength."""

    name: str
    sigma_a: SphereQuantity
    sigma_s_reduced: SphereQuantity
    g: SphereQuantity
    sigma_s: SphereQuantity | None
    """Null where the collimated transmittance was not measured, as is sigma_t."""
    sigma_t: SphereQuantity | None
    absorption_ratio: SphereQuantity | None
    """sigma_a / sigma_s_reduced where no light comes through; null elsewhere."""
    R: float
    """Measured value, as are T and T_unscattered."""
    T: float | None
    T_unscattered: float | None
    R_fitted: float
    T_fitted: float | None
    distance_se: float
    """Distance of the fitted readings from the measured ones in standard errors; 0 where a slab reads the same."""
    converged: bool
    """Whether a slab reads what was measured, but for noise."""
    other_slabs: tuple[OtherSlab, ...]
    notes: tuple[str, ...]


def quantity(
    value: float, se: float, unit: SlabUnit, *, judged_by: float | None = None, shown_to: float | None = None
) -> SphereQuantity:
    """A quantity; it is not shown where its standard error is beyond its own size.

    Args:
        judged_by: what a twentieth of which the standard error of a determined value does not exceed; the value itself
            where None. 0 stands for a value that was given and not measured.
        shown_to: largest standard error of a value that is shown; the value itself where None.
    """
    size = abs(value) if judged_by is None else judged_by
    is_shown = se <= (abs(value) if shown_to is None else shown_to)
    return SphereQuantity(
        value=value if is_shown else None,
        se=se if is_shown else None,
        unit=unit,
        determined=is_shown and size > 0 and se <= LARGEST_COEFFICIENT_SHARE * size,
    )


def left_open(unit: SlabUnit) -> SphereQuantity:
    """A quantity that the readings leave open."""
    return SphereQuantity(value=None, se=None, unit=unit, determined=False)


def not_determined(one: SphereQuantity) -> SphereQuantity:
    """The same, called not determined."""
    return one.model_copy(update={"determined": False})
