"""Scenes in files, from which every process that renders builds them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.choices import chosen
from services.core.files.content_files import StoredFile, write_arrays
from services.core.geometry import Mesh
from services.core.records import Boundary, Device
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces

SHARP_BORDER_MM = np.array(0.0)
"""Width of the borders between enamel and dentin, which are sharp. Nothing reads it: it stays in the file because fits
find their checkpoints by the digests of the scenes."""


def write_recipe(folder: Path, recipe: SceneRecipe) -> StoredFile:
    """Store a recipe in ``folder``."""
    arrays: dict[str, NDArray[Any]] = {}

    def add(name: str, mesh: Mesh | None) -> None:
        if mesh is not None:
            arrays.update({f"{name}_vertices": mesh.vertices_mm, f"{name}_faces": mesh.faces})

    for k, tooth in enumerate(recipe.all_teeth):
        add(f"outer{k}", tooth.outer)
        if tooth.dentin is not None:
            add(f"dentin{k}", tooth.dentin.base)
            arrays[f"dentin{k}_modes"] = tooth.dentin.modes_mm
        if tooth.stain_uv is not None:
            arrays[f"stain{k}_uv"] = tooth.stain_uv
    add("gums", recipe.gums)
    add("cavity", recipe.cavity)
    # A scene of another boundary keeps the file, and so the name, that it had before there was this one.
    if recipe.boundary == "rough":
        arrays["roughness"] = np.array(recipe.roughness)
        arrays["multiple_scattering"] = np.array(recipe.multiple_scattering)
    return write_arrays(
        folder,
        "scene",
        teeth=np.array(len(recipe.teeth)),
        neighbours=np.array(len(recipe.neighbours)),
        light_positions=recipe.light_positions_mm,
        light_intensities=recipe.light_intensities,
        boundary=np.array(recipe.boundary),
        ior=np.array(recipe.ior),
        gums_ior=np.array(recipe.gums_ior),
        border_width_mm=SHARP_BORDER_MM,
        device=np.array(recipe.device or ""),
        **arrays,
    )


def read_recipe(stored: StoredFile) -> SceneRecipe:
    """Read a recipe."""
    a = stored.load()

    def mesh(name: str) -> Mesh | None:
        return (
            Mesh(a[f"{name}_vertices"].astype(float), a[f"{name}_faces"].astype(np.int32))
            if f"{name}_faces" in a
            else None
        )

    def tooth(k: int) -> ToothSurfaces:
        outer, base = mesh(f"outer{k}"), mesh(f"dentin{k}")
        assert outer is not None
        dentin = None if base is None else DentinShape(base, a[f"dentin{k}_modes"].astype(float))
        return ToothSurfaces(outer, dentin, a[f"stain{k}_uv"].astype(float) if f"stain{k}_uv" in a else None)

    own, others = (int(np.asarray(a[name], dtype=int)) for name in ("teeth", "neighbours"))
    recipe = SceneRecipe(
        teeth=tuple(tooth(k) for k in range(own)),
        neighbours=tuple(tooth(k) for k in range(own, own + others)),
        light_positions_mm=a["light_positions"].astype(float),
        light_intensities=a["light_intensities"].astype(float),
        boundary=chosen("Boundary", str(a["boundary"]), {name: name for name in get_args(Boundary)}),
        ior=float(np.asarray(a["ior"], dtype=float)),
        device=chosen("Device", str(a["device"]), {"": None, **{name: name for name in get_args(Device)}}),
        gums=mesh("gums"),
        gums_ior=float(np.asarray(a["gums_ior"], dtype=float)),
        cavity=mesh("cavity"),
    )
    if "roughness" not in a:
        return recipe
    roughness, multiple_scattering = (np.asarray(a[name]) for name in ("roughness", "multiple_scattering"))
    return replace(recipe, roughness=float(roughness), multiple_scattering=bool(multiple_scattering))
