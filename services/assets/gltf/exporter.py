"""Writes ``asset.gltf`` and ``asset.bin`` (glTF 2.0, Khronos 2017), with ratified extensions alone.

Lengths are metres and y points up, as glTF wants it, where the asset's z does. glTF has no scattering media, so enamel
and gums are shown by their reflectance, as dentin is. The absorption is stated as a volume's attenuation over a short
distance, and all coefficients stand with their standard errors in the materials' ``extras``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.content import AssetContent, AssetPart
from services.assets.surface_material import LOST, Appearance, appearance
from services.assets.textures.files import base_colour_file
from services.core.store import write_atomic

METRES_PER_MM = 1e-3
Y_UP = ([0, 2, 1], [1, 1, -1])
"""Order and signs of an asset's coordinates in glTF: (x, y, z) becomes (x, z, -y)."""
SHORT = 0.02
"""Optical depth of the attenuation distance. Blender reads the attenuation by (1 - c) / d, which is right for short
distances alone: it is 0.97 to 0.99 of the absorption at this one, and 0.27 to 0.63 at a depth of 1."""
FLOAT, UINT = 5126, 5125
LINEAR, CLAMP = 9729, 33071
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class GltfExporter:
    """Exporter of glTF 2.0."""

    def check(self) -> None:
        """Nothing is needed but what every export needs."""

    def write(self, content: AssetContent, folder: Path) -> None:
        """Write one node, mesh and material for each part, in metres."""
        binary = bytearray()
        views: list[dict[str, Any]] = []
        accessors: list[dict[str, Any]] = []

        def accessor(values: NDArray[Any], kind: str, *, bounds: bool = False) -> int:
            is_index = kind == "SCALAR"
            target = ELEMENT_ARRAY_BUFFER if is_index else ARRAY_BUFFER
            stored = np.ascontiguousarray(values, dtype="<u4" if is_index else "<f4")
            views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": stored.nbytes, "target": target})
            binary.extend(stored.tobytes())
            told: dict[str, Any] = {
                "bufferView": len(views) - 1,
                "componentType": UINT if is_index else FLOAT,
                "count": len(stored),
                "type": kind,
            }
            if bounds:
                told |= {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
            accessors.append(told)
            return len(accessors) - 1

        meshes = []
        for k, part in enumerate(content.parts):
            mesh = part.mesh
            attributes = {
                "POSITION": accessor(_turned(mesh.vertices_mm) * METRES_PER_MM, "VEC3", bounds=True),
                "NORMAL": accessor(_turned(mesh.normals), "VEC3"),
                "TEXCOORD_0": accessor(mesh.uv, "VEC2"),
            }
            primitive = {"attributes": attributes, "indices": accessor(mesh.faces.reshape(-1), "SCALAR"), "material": k}
            meshes.append({"name": part.name, "primitives": [primitive]})
        pictures = [part.name for part in content.parts if part.name in content.textures]
        materials = [
            _material(part, appearance(content, part), content.textures.get(part.name), pictures)
            for part in content.parts
        ]
        used = sorted({name for material in materials for name in material.get("extensions", {})})
        said = {"lost": LOST, "colours": content.told_colours, "converged": content.converged}
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "dentine", "extras": said},
            "scene": 0,
            # Programs show what a scene says, and pass over what the asset does.
            "scenes": [{"nodes": list(range(len(meshes))), "extras": said}],
            "nodes": [{"name": part.name, "mesh": k} for k, part in enumerate(content.parts)],
            "meshes": meshes,
            "materials": materials,
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"uri": "asset.bin", "byteLength": len(binary)}],
        } | ({"extensionsUsed": used} if used else {})
        if pictures:
            document |= {
                "images": [{"name": f"{name}_base_colour", "uri": base_colour_file(name)} for name in pictures],
                "textures": [{"source": k, "sampler": 0} for k in range(len(pictures))],
                "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
            }
        write_atomic(folder / "asset.bin", bytes(binary))
        write_atomic(folder / "asset.gltf", (json.dumps(document, indent=1) + "\n").encode())


def _turned(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    order, signs = Y_UP
    return vectors[:, order] * signs


def _material(
    part: AssetPart, look: Appearance, textures: Mapping[str, Any] | None, pictures: Sequence[str]
) -> dict[str, Any]:
    extensions: dict[str, Any] = {}
    if look.ior is not None:
        extensions["KHR_materials_ior"] = {"ior": look.ior}
    absorption = part.absorption_per_mm()
    if part.media() and absorption.max() > 0:
        distance_mm = SHORT / absorption.max()
        extensions["KHR_materials_transmission"] = {"transmissionFactor": 0.0}
        extensions["KHR_materials_volume"] = {
            # A thickness of 0 would mean a surface without a volume, and the attenuation would be ignored.
            "thicknessFactor": distance_mm * METRES_PER_MM,
            "attenuationDistance": distance_mm * METRES_PER_MM,
            "attenuationColor": np.exp(-absorption * distance_mm).tolist(),
        }
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": look.roughness}
    told: dict[str, Any] = {"coefficients": part.told_estimates()}
    if textures is None:
        surface["baseColorFactor"] = [*look.base_colour, 1.0]
    else:
        surface["baseColorTexture"] = {"index": pictures.index(part.name)}
        told["textures"] = dict(textures)
    material = {"name": part.name, "pbrMetallicRoughness": surface, "extras": told}
    return material | ({"extensions": extensions} if extensions else {})
