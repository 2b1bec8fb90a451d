"""Scene of teeth, gums and the wall of the mouth for stock Mitsuba; one colour channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from services.anatomy.scans.separation import separate
from services.assets.mitsuba.scene import (
    SceneDict,
    boundary_dict,
    lit_scene,
    medium_dict,
    sensor_dict,
    surface_dict,
)
from services.core.files.meshes import write_mesh
from services.core.geometry import Camera, Mesh, Tooth
from services.core.records import Boundary
from services.core.surface.rough import DEFAULT_ROUGHNESS
from services.transport.optics.parameters import Mouth

SurfaceFiles = Mapping[str, Path]
"""PLY files by the name of the surface: ``crown_11``, ``root_11``, ``dentin_11`` and ``contact_11_12`` by FDI number,
``gums``, ``cavity``."""


def write_mouth_surfaces(
    folder: Path, teeth: tuple[Tooth, ...], gums: Mesh | None, cavity: Mesh | None
) -> dict[str, Path]:
    """Write the surfaces between media, which do not overlap; an empty surface has no file.

    Raises:
        MeshError: a tooth overlaps the dentin of another, or a surface cannot be cut.
    """
    parts = separate(teeth, gums)
    meshes = {"gums": parts.gums} | ({} if cavity is None else {"cavity": cavity})
    for tooth, crown, root in zip(teeth, parts.crowns, parts.roots, strict=True):
        meshes |= {f"crown_{tooth.fdi}": crown, f"root_{tooth.fdi}": root}
        if tooth.dentin is not None:
            meshes[f"dentin_{tooth.fdi}"] = tooth.dentin
    meshes |= {f"contact_{teeth[i].fdi}_{teeth[j].fdi}": mesh for (i, j), mesh in parts.contacts.items()}
    files = {name: folder / f"{name}.ply" for name, mesh in meshes.items() if len(mesh.faces)}
    for name, path in files.items():
        write_mesh(path, meshes[name])
    return files


def mouth_scene(
    files: SurfaceFiles,
    fdi: tuple[int, ...],
    mouth: Mouth,
    cameras: tuple[Camera, ...],
    light_mm: Sequence[Any],
    intensity: Any,
    *,
    boundary: Boundary = "matched",
    ior: float = 1.631,
    gums_ior: float = 1.33,
    samples: Any = 64,
    roughness: float = DEFAULT_ROUGHNESS,
    compensated: bool = False,
) -> SceneDict:
    """Scene of a mouth under one point light; for the other arguments see ``scene.nested_scene``.

    Args:
        files: surfaces that ``write_mouth_surfaces`` wrote.
        fdi: FDI numbers in the order of the mouth's teeth.
        gums_ior: refractive index of the gums.
        roughness, compensated: of a rough surface, see ``rough_surface``.
    """
    scene = lit_scene(light_mm, intensity)
    for number, tissue in zip(fdi, mouth.teeth, strict=True):
        scene |= {
            f"medium_enamel_{number}": medium_dict(tissue.enamel),
            f"medium_dentin_{number}": medium_dict(tissue.dentin),
        }
    if mouth.gums is not None:
        scene["medium_gums"] = medium_dict(mouth.gums)

    def between(path: Path, contrast: float, inside: str, outside: str | None = None) -> SceneDict:
        sides = {"interior": {"type": "ref", "id": f"medium_{inside}"}} | (
            {"exterior": {"type": "ref", "id": f"medium_{outside}"}} if outside else {}
        )
        face = boundary_dict(boundary, contrast, roughness=roughness, compensated=compensated)
        return surface_dict(path, {"type": "null"} if contrast == 1 else face) | sides

    for name, path in files.items():
        kind, _, suffix = name.partition("_")
        if kind == "crown":
            scene[name] = between(path, ior, f"enamel_{suffix}")
        elif kind == "root":
            scene[name] = between(path, ior / gums_ior, f"enamel_{suffix}", "gums")
        elif kind == "dentin":
            scene[name] = between(path, 1.0, f"dentin_{suffix}", f"enamel_{suffix}")
        elif kind == "contact":
            scene[name] = between(path, 1.0, *(f"enamel_{number}" for number in suffix.split("_")))
        elif kind == "gums":
            scene[name] = between(path, gums_ior, "gums")
        else:
            wall = {"type": "diffuse", "reflectance": {"type": "uniform", "value": mouth.reflectance}}
            scene[name] = surface_dict(path, {"type": "twosided", "nested": wall})
    return scene | {f"camera_{camera.name}": sensor_dict(camera, samples) for camera in cameras}
