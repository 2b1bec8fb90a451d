"""Checks of the engine's input and results; each error names the quantity that is wrong, and its value.

Media are checked by ``media.require_medium``, meshes by their own methods.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError, NonFiniteError
from services.core.surface.rough import MIN_ROUGH_IOR, ROUGHNESS
from services.transport.scene.recipe import SceneRecipe, View

FARTHEST_MM = 1e12
"""Largest distance of a light from the origin in mm, a million kilometres; farther away, squares of distances leave the
range of single precision."""
INTENSITIES = (1e-30, 1e30)
"""Smallest and largest intensity of a light, for the same reason."""
MAX_TEETH = 15
"""Largest number of teeth: an enclosure is 32 bits, two for each tooth and one for gums."""


def require_lights(positions_mm: NDArray[np.float64], intensities: NDArray[np.float64], reach_mm: float) -> None:
    """Refuse lights that cannot light a tooth about the origin that reaches ``reach_mm`` far.

    Raises:
        InputError: there is no light, or one is not finite, dark, too bright, too far away, or where the tooth is.
    """
    if len(positions_mm) == 0:
        raise InputError("The scene has no light; list at least one with a position and an intensity.")
    for number, (position, intensity) in enumerate(zip(positions_mm, intensities, strict=True)):
        if not np.isfinite(position).all():
            raise InputError(
                f"Light {number} has position_mm = {position.tolist()}, which is not finite; correct the rig's"
                " calibration."
            )
        if not INTENSITIES[0] <= intensity <= INTENSITIES[1]:
            low, high = INTENSITIES
            raise InputError(
                f"Light {number} has intensity = {intensity:g}, which must lie in {low:g} to {high:g}; correct the"
                " rig's calibration."
            )
        if np.linalg.norm(position) > FARTHEST_MM:
            raise InputError(
                f"Light {number} is {np.linalg.norm(position):.3g} mm away, farther than single precision can follow; "
                f"put it within {FARTHEST_MM:g} mm and lower its intensity with the distance squared."
            )
        if np.linalg.norm(position) <= reach_mm:
            raise InputError(
                f"Light {number} at position_mm = {position.tolist()} is within {reach_mm:.0f} mm of the origin, where"
                " the tooth is; lights must be outside it, in millimetres."
            )


def require_rough(recipe: SceneRecipe) -> None:
    """Refuse what a ``rough`` boundary cannot be or surround.

    Raises:
        InputError: a roughness out of its range, or an index too close to that of air.
    """
    low, high = ROUGHNESS
    if not low <= recipe.roughness <= high:
        raise InputError(
            f"roughness = {recipe.roughness:g} must lie in {low:g} to {high:g}; give the GGX roughness of the surface,"
            " such as 0.15, or choose boundary = thin."
        )
    if recipe.ior < MIN_ROUGH_IOR:
        raise InputError(
            f"ior = {recipe.ior:g} is too close to that of air for a rough surface, which needs at least"
            f" {MIN_ROUGH_IOR:g}; choose boundary = matched."
        )
    if recipe.gums is not None and recipe.gums_ior < MIN_ROUGH_IOR:
        raise InputError(
            f"gums_ior = {recipe.gums_ior:g} is too close to that of air for a rough surface, which needs at least"
            f" {MIN_ROUGH_IOR:g}; give that of gums, 1.33."
        )


def require_straight(recipe: SceneRecipe, what: str) -> None:
    """Refuse a gradient that needs light that crosses outer faces straight on.

    Raises:
        InputError: the scene's boundary bends light.
    """
    if recipe.boundary == "rough":
        raise InputError(f"boundary = rough has not {what}; take the Jacobian, or choose boundary = thin.")


def require_surfaces(recipe: SceneRecipe) -> None:
    """Refuse surfaces that cannot bound media, and more teeth than a scene can hold.

    Raises:
        MeshError: names the surface.
        InputError: no tooth, or too many, or neighbours of several.
    """
    if not 0 < len(recipe.all_teeth) <= MAX_TEETH:
        raise InputError(f"The scene has {len(recipe.all_teeth)} teeth; give 1 to {MAX_TEETH}.")
    if recipe.neighbours and len(recipe.teeth) > 1:
        raise InputError(
            f"The scene has neighbours of {len(recipe.teeth)} teeth, and only those of one can have its media; list"
            " them among the teeth."
        )
    for number, tooth in enumerate(recipe.all_teeth):
        which = "" if len(recipe.all_teeth) == 1 else f" of tooth {number}"
        tooth.outer.require_solid(f"outer surface{which}")
        if tooth.dentin is not None:
            tooth.dentin.base.require_solid(f"dentin surface{which}")
    if recipe.gums is not None:
        recipe.gums.require_solid("gums")
    if recipe.cavity is not None:
        recipe.cavity.require_surface("cavity")


def require_view(view: View, recipe: SceneRecipe) -> None:
    """Refuse a view without pixels, with pixels or lights that do not exist, or with its camera inside a tooth's box.

    Raises:
        InputError: names the camera.
    """
    name, lights = view.camera.name, len(recipe.light_positions_mm)
    pose = np.asarray(view.camera.camera_from_world)
    camera_centre_mm = -pose[:3, :3].T @ pose[:3, 3]
    if any(
        (camera_centre_mm >= tooth.outer.vertices_mm.min(axis=0)).all()
        and (camera_centre_mm <= tooth.outer.vertices_mm.max(axis=0)).all()
        for tooth in recipe.all_teeth
    ):
        where = ", ".join(f"{c:.4g}" for c in camera_centre_mm)
        raise InputError(
            f"Camera {name} stands at ({where}) mm, where the tooth is; camera_from_world must be in millimetres, as"
            " the meshes are."
        )
    if len(view) == 0:
        raise InputError(f"Camera {name} lists no pixel; its valid mask is empty.")
    outside = ((view.pixels < 0) | (view.pixels >= view.camera.size)).any(axis=1)
    if outside.any():
        x, y = view.pixels[outside][0]
        raise InputError(
            f"Camera {name} lists pixel ({x}, {y}), outside its {view.camera.size[0]} x {view.camera.size[1]}; correct"
            " the list."
        )
    if view.lights is not None and not (
        view.lights and set(view.lights) <= set(range(lights)) and len(set(view.lights)) == len(view.lights)
    ):
        raise InputError(
            f"Camera {name} lists lights = {view.lights}; they must be different indices below {lights}, at least one."
        )


def require_cotangent(cotangent: NDArray[np.float64], view: View, recipe: SceneRecipe) -> None:
    """Refuse a cotangent that is not one finite number for each image's pixel.

    Raises:
        InputError: names the shape, or the first weight that is not finite.
    """
    expected = len(recipe.light_positions_mm), len(view)
    if np.shape(cotangent) != expected:
        raise InputError(
            f"The cotangent has shape {np.shape(cotangent)}; give a weight for each of {expected[0]} lights and"
            f" {expected[1]} pixels, {expected}."
        )
    bad = np.argwhere(~np.isfinite(cotangent))
    if len(bad):
        raise InputError(
            f"The cotangent is {cotangent[tuple(bad[0])]} at light {bad[0][0]} and pixel {bad[0][1]}; give finite"
            " weights, 0 for what does not count."
        )


def require_finite_gradient(what: str, view: View, *arrays: NDArray[np.float64]) -> None:
    """Refuse the gradient of a view's images that holds NaN or infinity.

    Raises:
        NonFiniteError: gives the count.
    """
    bad = sum(int((~np.isfinite(array)).sum()) for array in arrays)
    if bad:
        raise NonFiniteError(
            f"{bad} numbers of the gradient to {what} by camera {view.camera.name} came out non-finite; report the"
            " parameters."
        )


def require_finite(arrays: list[NDArray[np.float64]], view: View) -> None:
    """Refuse results (batches, N, slots) that hold NaN or infinity, whatever the slot.

    Raises:
        NonFiniteError: gives the count and the first pixels.
    """
    bad = np.zeros(len(view), dtype=bool)
    for array in arrays:
        bad |= ~np.isfinite(array).all(axis=(0, 2))
    if bad.any():
        where = ", ".join(f"({x}, {y})" for x, y in view.pixels[bad][:3])
        raise NonFiniteError(
            f"{int(bad.sum())} of {len(view)} pixels of camera {view.camera.name} came out non-finite, first at"
            f" {where}; report the parameters."
        )
