"""Writes ``asset.usda`` (OpenUSD in its text form) and ``asset.mtlx`` beside it.

Lengths are mm, z points up. Each surface has a UsdPreviewSurface and an OpenPBR shader. The coefficients stand as
``float3`` attributes of the mesh, red, green and blue, as programs keep those and lose arrays.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from services.assets.content import AssetContent, AssetPart
from services.assets.surface_material import LOST, Appearance, appearance, open_pbr_inputs
from services.assets.usd.materialx import document
from services.assets.usd.text import INDENT, array, number, prim, quoted, vector
from services.core.store import write_atomic
from services.transport.optics.parameters import MEDIUM_FIELDS

ROOT = "asset"
"""Name of the prim that holds all others."""
USER = "userProperties:"
"""Namespace whose attributes programs show to a user; Blender makes custom properties of them."""
USD_TYPES = {"float": "float", "color3": "color3f"}


class UsdExporter:
    """Exporter of USD."""

    def check(self) -> None:
        """Nothing is needed but what every export needs."""

    def write(self, content: AssetContent, folder: Path) -> None:
        """Write one mesh and material for each part."""
        looks = {part.name: appearance(content, part) for part in content.parts}
        materials = [line for name, look in looks.items() for line in _material(name, look)]
        children = prim("Scope", "materials", materials)
        for part in content.parts:
            children += _mesh(part, content.shown_channels, content.textures.get(part.name))
        metadata = [
            f"defaultPrim = {quoted(ROOT)}",
            f"doc = {quoted(LOST)}",
            "metersPerUnit = 0.001",
            'upAxis = "Z"',
        ]
        told = [
            f"custom string {USER}colours = {quoted(content.told_colours)}",
            f"custom bool {USER}converged = {int(content.converged)}",
            f"custom string {USER}lost = {quoted(LOST)}",
        ]
        lines = ["#usda 1.0", "(", *(INDENT + line for line in metadata), ")", ""]
        lines += prim("Xform", ROOT, [*told, *children], ['kind = "component"'])
        write_atomic(folder / "asset.mtlx", document(looks, LOST))
        write_atomic(folder / "asset.usda", ("\n".join(lines) + "\n").encode())


def _mesh(part: AssetPart, channels: Sequence[str], textures: Mapping[str, Any] | None) -> list[str]:
    mesh = part.mesh
    # The first row of a texture lies at v = 0 in an asset, and at v = 1 in USD.
    uv = mesh.uv * [1, -1] + [0, 1]
    low, high = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
    lines = [
        "uniform bool doubleSided = 0",
        f"float3[] extent = {array([low, high])}",
        f"int[] faceVertexCounts = {array([3] * len(mesh.faces))}",
        f"int[] faceVertexIndices = {array(mesh.faces.reshape(-1))}",
        f"rel material:binding = </{ROOT}/materials/{part.name}>",
        f'normal3f[] normals = {array(mesh.normals)} (interpolation = "vertex")',
        f"point3f[] points = {array(mesh.vertices_mm)}",
        f'texCoord2f[] primvars:st = {array(uv)} (interpolation = "vertex")',
        'uniform token subdivisionScheme = "none"',
        *_coefficients(part, channels),
    ]
    if textures is not None:
        lines.append(f"custom string {USER}textures = {quoted(json.dumps(textures))}")
    return prim("Mesh", part.name, lines, ['prepend apiSchemas = ["MaterialBindingAPI"]'])


def _coefficients(part: AssetPart, channels: Sequence[str]) -> list[str]:
    """Values and standard errors as ``float3``, and every channel with units and flags as text.

    A medium's five numbers stand there whether they were fitted or assumed.
    """
    media = part.media()
    is_medium = all(channel in media for channel in channels)
    assumed = {name: [getattr(media[one], name) for one in channels] for name in MEDIUM_FIELDS if is_medium}
    tables = [part.estimates[channel] for channel in channels]
    lines = []
    for name in sorted({*assumed, *set.intersection(*(set(table) for table in tables))}):
        found = [table[name] for table in tables if name in table]
        unit = found[0].unit if found else "1"
        spelled = name if unit == "1" else f"{name}_{unit.replace('1/', 'per_')}"
        lines.append(
            f"custom float3 {USER}{spelled} = {vector(assumed.get(name) or [estimate.value for estimate in found])}"
        )
        errors = [estimate.se for estimate in found if estimate.se is not None]
        if len(errors) == len(tables):
            lines.append(f"custom float3 {USER}{spelled}_se = {vector(errors)}")
    lines.append(f"custom string {USER}channels = {quoted(', '.join(channels))}")
    lines.append(f"custom string {USER}estimates = {quoted(json.dumps(part.told_estimates()))}")
    return lines


def _material(name: str, look: Appearance) -> list[str]:
    path = f"/{ROOT}/materials/{name}"
    preview = [
        'uniform token info:id = "UsdPreviewSurface"',
        f"color3f inputs:diffuseColor.connect = <{path}/picture.outputs:rgb>"
        if look.picture
        else f"color3f inputs:diffuseColor = {vector(look.base_colour)}",
        f"float inputs:ior = {number(look.ior or 1.0)}",
        f"float inputs:roughness = {number(look.roughness)}",
        "token outputs:surface",
    ]
    pbr = ['uniform token info:id = "ND_open_pbr_surface_surfaceshader"']
    for key, (kind, value) in open_pbr_inputs(look).items():
        if isinstance(value, str):
            pbr.append(f"{USD_TYPES[kind]} inputs:{key}.connect = <{path}/open_pbr_picture.outputs:out>")
        else:
            text = number(value) if isinstance(value, float) else vector(value)
            pbr.append(f"{USD_TYPES[kind]} inputs:{key} = {text}")
    pbr.append("token outputs:surface")
    lines = [
        f"token outputs:mtlx:surface.connect = <{path}/open_pbr.outputs:surface>",
        f"token outputs:surface.connect = <{path}/preview.outputs:surface>",
        *prim("Shader", "preview", preview),
        *prim("Shader", "open_pbr", pbr),
    ]
    return prim("Material", name, lines + (_picture(path, look.picture) if look.picture else []))


def _picture(path: str, picture: str) -> list[str]:
    """Shaders that look a picture up at ``st``, for the preview and for OpenPBR."""
    places = [
        'uniform token info:id = "UsdPrimvarReader_float2"',
        'string inputs:varname = "st"',
        "float2 outputs:result",
    ]
    texture = [
        'uniform token info:id = "UsdUVTexture"',
        f"asset inputs:file = @{picture}@",
        'token inputs:sourceColorSpace = "sRGB"',
        f"float2 inputs:st.connect = <{path}/places.outputs:result>",
        'token inputs:wrapS = "clamp"',
        'token inputs:wrapT = "clamp"',
        "float3 outputs:rgb",
    ]
    pbr_places = [
        'uniform token info:id = "ND_geompropvalue_vector2"',
        'string inputs:geomprop = "st"',
        "float2 outputs:out",
    ]
    pbr_texture = [
        'uniform token info:id = "ND_image_color3"',
        f'asset inputs:file = @{picture}@ (colorSpace = "srgb_texture")',
        f"float2 inputs:texcoord.connect = <{path}/open_pbr_places.outputs:out>",
        "color3f outputs:out",
    ]
    shaders = {"places": places, "picture": texture, "open_pbr_places": pbr_places, "open_pbr_picture": pbr_texture}
    return [line for name, lines in shaders.items() for line in prim("Shader", name, lines)]
