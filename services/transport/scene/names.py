"""Names of a scene's parameters, and the medium and field that each name refers to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.core.errors import InputError
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Stain, Tissue
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces


@dataclass(frozen=True)
class MediaNumbers:
    """Numbers of the media of a scene: enamel and dentin of each tooth in turn, gums, and the wall's reflectance as an
    albedo. 0 is empty space. Neighbours of a single tooth have its numbers.
    """

    teeth: int
    dentin: bool
    """Whether any tooth has dentin; then each has two numbers."""
    gums: bool
    cavity: bool

    def of(self, tooth: int, part: str) -> int:
        """Number of ``enamel`` or ``dentin`` of a tooth."""
        return 1 + tooth * (1 + self.dentin) + (part == "dentin")

    @property
    def of_gums(self) -> int:
        """Number of the gums."""
        return 1 + self.teeth * (1 + self.dentin)

    @property
    def of_cavity(self) -> int:
        """Number of the wall."""
        return self.of_gums + self.gums


@dataclass(frozen=True)
class Parameter:
    """One parameter of a scene: a field of a medium, or a weight of a tooth's dentin shape."""

    medium: int
    field: str
    shape: int | None = None
    """Index of the tooth whose dentin shape it changes; None for a field of a medium."""


def media_numbers(recipe: SceneRecipe) -> MediaNumbers:
    """Numbers of the scene's media."""
    return MediaNumbers(
        len(recipe.teeth),
        any(tooth.dentin is not None for tooth in recipe.all_teeth),
        recipe.gums is not None,
        recipe.cavity is not None,
    )


def parameter_names(recipe: SceneRecipe) -> dict[str, Parameter]:
    """All parameters of a scene by name; a single tooth's carry no number (see ``Tissue`` and ``Mouth``)."""
    numbers = media_numbers(recipe)
    named: dict[str, Parameter] = {}
    for k, tooth in enumerate(recipe.teeth):
        prefix = "" if len(recipe.teeth) == 1 else f"{k}."
        for part in ("enamel",) if tooth.dentin is None else ("enamel", "dentin"):
            named |= {f"{prefix}{part}.{field}": Parameter(numbers.of(k, part), field) for field in MEDIUM_FIELDS}
        modes = 0 if tooth.dentin is None else len(tooth.dentin.modes_mm)
        named |= {f"{prefix}shape.{mode}": Parameter(0, "shape", k) for mode in range(modes)}
    if recipe.boundary == "rough" and recipe.ior != 1:
        named["roughness"] = Parameter(0, "roughness")
    if numbers.gums:
        named |= {f"gums.{field}": Parameter(numbers.of_gums, field) for field in MEDIUM_FIELDS}
    if numbers.cavity:
        named["cavity.reflectance"] = Parameter(numbers.of_cavity, "alpha")
    return named


def media_of(mouth: Mouth, recipe: SceneRecipe) -> list[Medium]:
    """A scene's media in the order of their numbers, checked; the wall is the last, with its reflectance as albedo.

    Raises:
        InputError: a part is missing or too many, or a parameter is outside its physical range.
    """
    from services.transport.scene.media import require_medium

    numbers, media = media_numbers(recipe), []
    if len(mouth.teeth) != len(recipe.teeth):
        raise InputError(
            f"Tissues of {len(mouth.teeth)} teeth were given for a scene of {len(recipe.teeth)}; give one for each."
        )
    for k, (tissue, tooth) in enumerate(zip(mouth.teeth, recipe.teeth, strict=True)):
        prefix = "" if len(recipe.teeth) == 1 else f"{k}."
        require_medium(f"{prefix}enamel", tissue.enamel)
        media.append(tissue.enamel)
        if numbers.dentin:
            # No enclosure of a tooth without dentin refers to its second number, so enamel fills it.
            media.append(tissue.enamel if tooth.dentin is None else tissue.dentin)
            require_medium(f"{prefix}dentin", media[-1])
        modes = 0 if tooth.dentin is None else len(tooth.dentin.modes_mm)
        # A solver's step that ends on a bound may be off by a rounding.
        if len(tissue.shape) != modes or not all(-1e-9 <= c <= 1 + 1e-9 for c in tissue.shape):
            raise InputError(
                f"{prefix}shape = {tissue.shape} must be {modes} blend weights between 0 and 1, one per dentin mode;"
                " correct it."
            )
        require_stain(f"{prefix}stain", tissue.stain, tooth)
    if (mouth.gums is None) == numbers.gums:
        raise InputError(
            f"The scene has {'' if numbers.gums else 'no '}gums and its media have"
            f" {'none' if numbers.gums else 'some'}; give both or neither."
        )
    if mouth.gums is not None:
        require_medium("gums", mouth.gums)
        media.append(mouth.gums)
    if (mouth.reflectance is None) == numbers.cavity:
        raise InputError(
            f"The scene has {'a' if numbers.cavity else 'no'} cavity and its media {'no' if numbers.cavity else 'a'}"
            " reflectance; give both or neither."
        )
    if mouth.reflectance is not None:
        if not 0 <= mouth.reflectance <= 1:
            raise InputError(f"cavity.reflectance = {mouth.reflectance:.10g} must lie in 0 to 1; correct it.")
        media.append(Medium(1.0, mouth.reflectance))
    return media


def require_stain(name: str, stain: Stain | None, tooth: ToothSurfaces) -> None:
    """Refuse a texture with texels outside 0 (excluded) to 1, or one for which a tooth has no coordinates.

    Raises:
        InputError: names the texture.
    """
    if stain is None:
        return
    texels = stain.transmittance
    if tooth.stain_uv is None:
        raise InputError(
            f"{name} is given for a tooth without texture coordinates; give its surface stain_uv, or leave the texture"
            " out."
        )
    if tooth.stain_uv.shape != (len(tooth.outer.faces), 3, 2) or not np.isfinite(tooth.stain_uv).all():
        raise InputError(
            f"{name}'s coordinates have shape {tooth.stain_uv.shape}; they must be finite and"
            f" ({len(tooth.outer.faces)}, 3, 2), one per corner."
        )
    if texels.ndim != 2 or texels.size == 0:
        raise InputError(f"{name} has shape {texels.shape}; it must be one channel, (H, W).")
    bad = ~((texels > 0) & (texels <= 1))
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"{name}[{row}, {column}] = {texels[row, column]:.10g} must be above 0 and at most 1; correct"
            f" {int(bad.sum())} texels."
        )


def whitened(tissue: Tissue | Mouth) -> Tissue | Mouth:
    """The same tissue without absorption."""
    if isinstance(tissue, Tissue):
        return _white(tissue)
    return Mouth(
        tuple(map(_white, tissue.teeth)), _white_gums(tissue.gums), None if tissue.reflectance is None else 1.0
    )


def _white(tissue: Tissue) -> Tissue:
    enamel, dentin = (replace(medium, alpha=1.0) for medium in (tissue.enamel, tissue.dentin))
    return replace(tissue, enamel=enamel, dentin=dentin, gums=_white_gums(tissue.gums))


def _white_gums(gums: Medium | None) -> Medium | None:
    return None if gums is None else replace(gums, alpha=1.0)
