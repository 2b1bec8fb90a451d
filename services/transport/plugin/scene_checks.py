"""Whether a picture of a scene can be right: dentin lies inside enamel, and cameras and lights outside of teeth."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from services.core.errors import InputError
from services.transport.plugin.scene_teeth import SceneTeeth
from services.transport.scene.geometry import DENTIN, ENAMEL

MAX_POINTS = 512
"""Largest number of points of one surface, light or camera that are tested."""
MAX_OUTSIDE = 0.01
"""Largest share of a dentin surface's points outside of enamel; single points may lie on the enamel's surface."""
DIRECTION = (0.36, 0.48, 0.8)
"""Direction of the rays by which a point is told inside from outside; any direction will do."""


def require_nested(scene: Any, teeth: SceneTeeth) -> None:
    """Require that every dentin surface lies inside an enamel surface.

    Raises:
        InputError: one does not; the message names it.
    """
    for name, vertices in teeth.dentin_vertices():
        step = -(-len(vertices) // MAX_POINTS)
        outside = ~_inside(scene, teeth, vertices[::step], ENAMEL)
        if outside.mean() > MAX_OUTSIDE:
            raise InputError(
                f"Dentin '{name}' lies outside of every enamel surface at {np.mean(outside):.0%} of its points; put it"
                " inside the enamel of its tooth."
            )


def require_lights(scene: Any, teeth: SceneTeeth) -> None:
    """Require lights whose numbers are finite, and which stand outside of teeth.

    Raises:
        InputError: a light has a number that is not finite, or stands inside a tooth; the message names it.
    """
    for number, emitter in enumerate(scene.emitters()):
        shape = emitter.get_shape()
        name = f"'{shape.id() if shape is not None else emitter.id()}' ({number + 1} of {len(scene.emitters())})"
        for key, value in mi.traverse(emitter):
            if not np.isfinite(_numbers(value)).all():
                raise InputError(f"Light {name} has a value in {key} that is no finite number; correct it.")
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite) or mi.has_flag(
            emitter.flags(), mi.EmitterFlags.DeltaDirection
        ):
            continue
        if _inside(scene, teeth, _places(emitter, shape), ENAMEL | DENTIN).any():
            raise InputError(f"Light {name} stands inside a tooth; move it outside.")


def require_camera(scene: Any, teeth: SceneTeeth, ray: mi.Ray3f) -> None:
    """Require camera rays that begin outside of teeth.

    Raises:
        InputError: one begins inside.
    """
    width = dr.width(ray.o)
    step = -(-width // MAX_POINTS)
    chosen = dr.arange(mi.UInt32, -(-width // step)) * step
    points = np.asarray(dr.gather(mi.Point3f, ray.o, chosen)).T if width > 1 else np.asarray(ray.o).reshape(1, 3)
    if _inside(scene, teeth, np.unique(points, axis=0), ENAMEL | DENTIN).any():
        raise InputError("The camera stands inside a tooth; move it outside, or give its pose in the scene's unit.")


def _inside(scene: Any, teeth: SceneTeeth, points: NDArray[Any], parts: int) -> NDArray[np.bool_]:
    """Whether points (N, 3) lie inside a surface of these parts: the first such surface along a ray is left, and not
    entered.
    """
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(points.T, dtype=np.float32)), mi.Vector3f(*DIRECTION))
    active, leaves = dr.isfinite(ray.o.x), mi.Bool(False)

    def step(ray: mi.Ray3f, active: mi.Bool, leaves: mi.Bool) -> tuple[mi.Ray3f, mi.Bool, mi.Bool]:
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        si = hit.compute_surface_interaction(ray, +mi.RayFlags.Minimal, active & hit.is_valid())
        meets = active & hit.is_valid()
        wanted = meets & ((teeth.part(hit, meets) & parts) != 0)
        leaves |= wanted & (dr.dot(ray.d, si.n) > 0)
        active = meets & ~wanted
        return dr.select(active, si.spawn_ray(ray.d), ray), active, leaves

    _, _, leaves = dr.while_loop((ray, active, leaves), _goes_on, step, label="points inside teeth")
    return np.asarray(leaves)


def _goes_on(ray: mi.Ray3f, active: mi.Bool, leaves: mi.Bool) -> mi.Bool:  # noqa: ARG001 - the loop's whole state
    return active


def _places(emitter: Any, shape: Any) -> NDArray[np.float64]:
    """Points (N, 3) at which a light stands."""
    if shape is None:
        return np.asarray(emitter.bbox().center(), dtype=np.float64).reshape(1, 3)
    rng = mi.PCG32(MAX_POINTS)
    sample = shape.sample_position(0.0, mi.Point2f(rng.next_float32(), rng.next_float32()))
    return np.asarray(sample.p, dtype=np.float64).T


def _numbers(value: Any) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)
