"""Rigid moves of the dome, and in a jaw of the scan: their effect on images enters the standard errors, but no fit
estimates them. A tooth's fit estimates the pose of its scan (``pose``).

Images under moved lights need many paths: a move changes an image by a few per cent, and two images of 256 paths differ
by as much by chance. As coordinates of a fit, such moves would follow that noise. So they are considered and not
estimated (Schmidt 1966): each move by one standard deviation changes the photographs, and with them the solution.

A dome whose calibration states the place of every light has no error of its own: it moves by the common part of the
lights' errors. The default of 2 mm would count those errors twice. Where the place of some light is not stated, the
default applies to all lights: that light has no other uncertainty, a dome moves as a whole, and the other lights'
distances are then in no gain (``irradiance``).

A tooth that moves by T under fixed cameras and lights gives the same images as a fixed tooth under cameras and lights
that move by T^-1, so no surface is built again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.calibration.uncertainty import TWIST, CalibrationUncertainty
from services.core.files.content_files import StoredFile
from services.core.geometry import Camera, Light
from services.fit.coordinates.instrument_errors import DEFAULT_MOVE_SE
from services.transport.scene.recipe import SceneRecipe
from services.transport.scene.recipe_files import write_recipe
from services.transport.scene.rigid_moves import moved_camera, rigid

Array = NDArray[np.float64]

MOVING_BODIES = tuple(DEFAULT_MOVE_SE)
"""Bodies that move rigidly: ``teeth`` and ``dome``."""
DIFFERENCE_WIDTH = 2.0
"""Standard deviations between the two images of a difference. A wider difference has less noise, and images 0.1 mm or 4
mm apart are still about linear."""
MAX_LIGHTS = 80
"""Largest number of lights in one scene, which holds the lights at their places and again as several moves put them;
more lights would need more memory for their maps."""


@dataclass(frozen=True)
class Move:
    """A move by ``DIFFERENCE_WIDTH`` standard deviations, as a change of lights and cameras."""

    body: str
    """``teeth`` or ``dome``."""
    recipe: StoredFile
    """Scene whose first lights stand at their calibrated places, and which holds them again where the move
    puts them."""
    first: int
    """Index of the first moved light."""
    camera_move: tuple[tuple[float, ...], ...]
    """Rigid transform (4, 4) that multiplies camera_from_world from the right."""

    def moved_camera(self, camera: Camera) -> Camera:
        """The camera after the move."""
        return moved_camera(camera, np.array(self.camera_move))


def is_dome_given_by_lights(stated: CalibrationUncertainty | None, lights: Sequence[Light]) -> bool:
    """Whether the place of every light is stated, which determines the dome's uncertainty, and no move of the dome is
    stated.
    """
    if stated is None or any(f"dome.{axis}" in stated.names for axis in TWIST):
        return False
    return all(name in stated.names for name in _position_names(lights))


def move_covariance(stated: CalibrationUncertainty | None, lights: Sequence[Light]) -> tuple[Array, tuple[str, ...]]:
    """Covariance (12, 12) of the moves of teeth and dome, and the bodies whose move is at least partly a default.

    Args:
        stated: the calibration's uncertainty.
        lights: all lights of the capture.
    """
    names = [f"{body}.{axis}" for body in MOVING_BODIES for axis in TWIST]
    covariance = np.diag([se**2 for body in MOVING_BODIES for se in DEFAULT_MOVE_SE[body]])
    own = [name for name in names if stated is not None and name in stated.names]
    if stated is not None:
        covariance[np.ix_(*2 * [[names.index(name) for name in own]])] = _stated(stated, own)
    if stated is not None and is_dome_given_by_lights(stated, lights):
        nearest = np.linalg.pinv(_twist_derivative(np.array([light.position_mm for light in lights])))
        covariance[len(TWIST) :, len(TWIST) :] = nearest @ _stated(stated, _position_names(lights)) @ nearest.T
        own += [name for name in names if name.startswith("dome.")]
    assumed = {name.partition(".")[0] for name in names if name not in own}
    return covariance, tuple(body for body in MOVING_BODIES if body in assumed)


def _position_names(lights: Sequence[Light]) -> list[str]:
    return [f"light.{light.name}.{axis}" for light in lights for axis in "xyz"]


def _stated(stated: CalibrationUncertainty, names: Sequence[str]) -> Array:
    indices = [stated.names.index(name) for name in names]
    return np.asarray(stated.matrix[np.ix_(indices, indices)])


def _twist_derivative(positions_mm: Array) -> Array:
    # Derivative (3 L, 6) of places (L, 3) with respect to a rotation w and a translation t about their mean, w x r + t.
    # Its pseudo-inverse gives the rigid move nearest to any errors of the places.
    arms_mm = positions_mm - positions_mm.mean(axis=0)
    rotated = np.cross(np.eye(3)[:, None], arms_mm).transpose(1, 2, 0)
    return np.concatenate([rotated, np.broadcast_to(np.eye(3), rotated.shape)], axis=2).reshape(-1, 6)


def write_moves(
    folder: Path, recipe: SceneRecipe, covariance: Array, dome_centre_mm: Array, *, keep_irradiance: bool = False
) -> tuple[Move, ...]:
    """Independent moves, whose covariances add up to the given one, with their scenes.

    Args:
        folder: receives the scenes.
        recipe: scene at the calibrated places.
        covariance: of the moves of teeth and dome, (12, 12).
        dome_centre_mm: point (3,) about which the dome turns.
        keep_irradiance: keep the irradiance at the teeth of lights that the dome moves, because their gains include the
            error of the distances.
    """
    teeth_centre_mm = np.concatenate([tooth.outer.vertices_mm for tooth in recipe.teeth]).mean(axis=0)
    lights, moves = recipe.light_positions_mm, list[tuple[str, Array, Array, Array]]()
    values, vectors = np.linalg.eigh(covariance)
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= 0:
            continue
        twist = DIFFERENCE_WIDTH * np.sqrt(value) * vector
        body = MOVING_BODIES[int(np.abs(vector[6:]).max() > np.abs(vector[:6]).max())]
        forth = rigid(twist[:6], teeth_centre_mm)
        back, moved = np.linalg.inv(forth), _moved(rigid(twist[6:], dome_centre_mm), lights)
        farther = ((moved - teeth_centre_mm) ** 2).sum(axis=1) / ((lights - teeth_centre_mm) ** 2).sum(axis=1)
        bright = recipe.light_intensities * (farther if keep_irradiance else 1.0)
        moves.append((body, _moved(np.asarray(back, dtype=np.float64), moved), bright, forth))
    found, count = list[Move](), max(MAX_LIGHTS // len(lights) - 1, 1)
    for start in range(0, len(moves), count):
        part = moves[start : start + count]
        positions = np.concatenate([lights, *(moved for _, moved, _, _ in part)])
        intensities = np.concatenate([recipe.light_intensities, *(bright for _, _, bright, _ in part)])
        stored = write_recipe(folder, replace(recipe, light_positions_mm=positions, light_intensities=intensities))
        found += [
            Move(body, stored, (k + 1) * len(lights), tuple(map(tuple, camera.tolist())))
            for k, (body, _, _, camera) in enumerate(part)
        ]
    return tuple(found)


def _moved(move: Array, points_mm: Array) -> Array:
    return np.asarray(points_mm @ move[:3, :3].T + move[:3, 3])
