"""Small scenes with difficult geometry: sliver triangles, rays along a face, enamel as thin as allowed, lights very
near and very far.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.geometry import Camera, Mesh
from services.transport.engine import Engine
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Tissue
from services.transport.scene.recipe import SceneRecipe, View, single_tooth

SEMI_AXES_MM = np.array([3.0, 2.0, 4.0])
BOX_MM = 4.0
DISTANCE_MM = 600.0
PIXELS = 8
DIRECTIONS = np.array(
    [[0.16, 0.98, 0.08], [0.84, 0.5, 0.17], [-0.87, 0.35, -0.35], [0, -0.99, 0.16], [0.08, 0.16, 0.98]]
)
"""Directions towards the lights (L, 3), not normalised."""
TISSUE = Tissue(Medium(3, 0.99, 0.9, 0.8, -0.2), Medium(8, 0.98, g1=0.7))
LARGEST_Z = 4.5
"""Number of standard errors below zero from which on an image counts as negative."""
SPLIT = 1e-9
"""Position at which slivers split an edge, as a fraction of its length."""


@dataclass(frozen=True)
class Scene:
    """A scene and, if there is one, another scene whose images must be equal within their standard errors."""

    name: str
    recipe: SceneRecipe
    tissue: Tissue
    like: SceneRecipe | None = None
    like_tissue: Tissue | None = None


@dataclass(frozen=True)
class SceneCheck:
    """Result of rendering a scene."""

    numbers: int
    """Number of computed values: one per pixel and light for the images, and as many for every derivative."""
    negative: int
    """Number of lights whose image, summed over pixels, is below zero by more than ``LARGEST_Z`` standard errors; the
    estimate of a single pixel may be negative."""
    error: float
    """Relative standard error of the images over all pixels and lights."""
    z: float | None
    """Largest difference, over lights, of a light's total from that of the scene that must be equal, in standard
    errors; None without such a scene."""


def scenes() -> Iterator[Scene]:
    """Yield all scenes, which are equal in every run."""
    outer, dentin = ellipsoid(SEMI_AXES_MM), ellipsoid(SEMI_AXES_MM - 0.3)
    plain = _recipe(outer, dentin)
    yield Scene("slivers", _recipe(with_slivers(outer), with_slivers(dentin)), TISSUE, plain, TISSUE)
    yield Scene(
        "slivers, thin faces",
        replace(_recipe(with_slivers(outer), dentin), boundary="thin"),
        TISSUE,
        replace(plain, boundary="thin"),
        TISSUE,
    )
    thinnest, all_dentin = ellipsoid(SEMI_AXES_MM - 1e-3), Tissue(TISSUE.dentin, TISSUE.dentin)
    yield Scene("enamel of 1 um", _recipe(outer, thinnest), TISSUE, _recipe(outer, None), all_dentin)
    yield Scene("almost no absorption", plain, Tissue(Medium(10, 1 - 1e-7, g1=0.9), Medium(30, 1 - 1e-7, g1=0.99)))
    yield Scene(
        "narrow lobes", plain, Tissue(Medium(100, 0.9, 0.5, 0.9999, -0.9999), Medium(1e-4, 0.5, 0.5, 0.9999, -0.9999))
    )
    in_planes = np.array([[300.0, 2, 0], [300, 0, 2], [2, 300, -2], [-300, 2, 2], [0, -2, 300]])
    for boundary in ("matched", "thin"):
        yield Scene(
            f"along faces, {boundary}",
            replace(_recipe(_box(), None), light_positions_mm=in_planes, boundary=boundary),
            TISSUE,
        )
    tips = np.array([[0, 0, 1.0], [0, 0, -1.0]]) * (SEMI_AXES_MM[2] + 1e-3)
    yield Scene("lights 1 um away", replace(plain, light_positions_mm=tips, light_intensities=np.ones(2)), TISSUE)
    far, farther = (
        replace(plain, light_positions_mm=_towards_lights(d), light_intensities=np.full(5, d**2)) for d in (1e5, 1e9)
    )
    yield Scene("lights 1000 km away", farther, TISSUE, far, TISSUE)


def check_scene(scene: Scene, *, samples: int, seed: int) -> SceneCheck:
    """Render the images and all derivatives of a scene, seen along the upper face of the box.

    Raises:
        NonFiniteError: a value is NaN or infinite.
    """
    parts = ("enamel",) if scene.recipe.teeth[0].dentin is None else ("enamel", "dentin")
    names = tuple(f"{part}.{field}" for part in parts for field in MEDIUM_FIELDS)
    engine, view = Engine(scene.recipe), _edge_on()
    image = engine.images(scene.tissue, view, samples=samples, seed=seed)
    jacobian = engine.jacobian(scene.tissue, view, names, samples=samples, seed=seed + 1)
    z = None
    if scene.like is not None and scene.like_tissue is not None:
        other = Engine(scene.like).images(scene.like_tissue, view, samples=samples, seed=seed + 2)
        # Sum over pixels for each light: pixels are independent, but the lights of one pixel share its paths.
        spread = np.sqrt(image.variance.sum(axis=1) + other.variance.sum(axis=1))
        z = float(np.max(np.abs(image.mean.sum(axis=1) - other.mean.sum(axis=1)) / spread))
    negative = int(np.count_nonzero(image.mean.sum(axis=1) < -LARGEST_Z * np.sqrt(image.variance.sum(axis=1))))
    error = float(np.sqrt(image.variance.sum()) / np.linalg.norm(image.mean))
    return SceneCheck(image.mean.size + jacobian.jacobian.size, negative, error, z)


def ellipsoid(semi_axes_mm: NDArray[np.float64]) -> Mesh:
    """Return an ellipsoid about the origin."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return Mesh(np.asarray(ball.vertices) * semi_axes_mm, np.asarray(ball.faces, dtype=np.int32))


def with_slivers(mesh: Mesh) -> Mesh:
    """Return the same surface with edges split at ``SPLIT`` of their length, which splits both triangles of such an
    edge.
    """
    vertices, faces = list(mesh.vertices_mm), [list(face) for face in mesh.faces.tolist()]
    beside: dict[tuple[int, int], list[int]] = {}
    for number, face in enumerate(faces):
        for k in range(3):
            beside.setdefault((min(face[k], face[k - 1]), max(face[k], face[k - 1])), []).append(number)
    untouched = set(range(len(faces)))
    for (a, b), pair in beside.items():
        if not untouched.issuperset(pair):
            continue
        untouched.difference_update(pair)
        vertices.append(vertices[a] + SPLIT * (vertices[b] - vertices[a]))
        new = len(vertices) - 1
        for number in pair:
            faces.append([new if corner == a else corner for corner in faces[number]])
            faces[number] = [new if corner == b else corner for corner in faces[number]]
    return Mesh(np.array(vertices), np.array(faces, dtype=np.int32))


def _box() -> Mesh:
    box = trimesh.creation.box((BOX_MM, BOX_MM, BOX_MM))
    return Mesh(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int32))


def _recipe(outer: Mesh, dentin: Mesh | None) -> SceneRecipe:
    known = None if dentin is None else DentinShape.known(dentin)
    return single_tooth(outer, known, _towards_lights(DISTANCE_MM), np.full(len(DIRECTIONS), DISTANCE_MM**2))


def _towards_lights(distance_mm: float) -> NDArray[np.float64]:
    return np.asarray(DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True) * distance_mm)


def _edge_on() -> View:
    """Return the view of a camera on the y axis at the height of the box's upper face, with a field of 9 mm."""
    focal = DISTANCE_MM * PIXELS / 9
    camera = Camera(
        name="edge-on",
        size=(PIXELS, PIXELS),
        K=((focal, 0, PIXELS / 2), (0, focal, PIXELS / 2), (0, 0, 1)),
        camera_from_world=((-1, 0, 0, 0), (0, 0, -1, BOX_MM / 2), (0, -1, 0, DISTANCE_MM), (0, 0, 0, 1)),
    )
    y, x = np.mgrid[0:PIXELS, 0:PIXELS]
    return View(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int32))
