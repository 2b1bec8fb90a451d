"""Materials of Blender 5 for the bodies of an asset: media as volume coefficients, and surfaces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

TOOTH_IOR = 1.631
"""Refractive index for a highlight."""
RADIUS_FACTOR = 4 * math.pi
"""Cycles divides the radius of its subsurface scattering by this factor to get a mean free path."""


@dataclass(frozen=True)
class Look:
    """What a user may choose about surfaces and scattering."""

    surface: str = "asset"
    roughness: float = 0.0
    """Roughness as Cycles has it: its square is GGX's alpha."""
    distribution: str = "GGX"
    """Of the facets of glass; MULTI_GGX gives back the light that meets several facets."""
    absorption: float = 1.0
    """Factor on the absorption of all media."""
    highlight: float | None = None
    smooth: bool = True
    subsurface: bool = False


class Nodes:
    """Nodes of a new material or of a world."""

    def __init__(self, owner: Any) -> None:
        if owner.node_tree is None:
            owner.use_nodes = True
        self.tree = owner.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, inputs: Mapping[Any, Any] | None = None, **settings: Any) -> Any:
        """Add a node; an input is a value, an output of a node, or a node, which stands for its first output."""
        try:
            node = self.tree.nodes.new(kind)
        except RuntimeError as problem:
            raise RuntimeError(
                f"Blender {bpy.app.version_string} has no {kind}; use Blender 5.0 or later."
            ) from problem
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, (bpy.types.Node, bpy.types.NodeSocket)):
                self.tree.links.new(
                    value if isinstance(value, bpy.types.NodeSocket) else value.outputs[0], node.inputs[key]
                )
            else:
                node.inputs[key].default_value = value
        return node

    def math(self, operation: str, *values: Any) -> Any:
        """Arithmetic on values or outputs."""
        return self.add("ShaderNodeMath", dict(enumerate(values)), operation=operation)

    def attribute(self, name: str) -> Any:
        """A number that the faces of the mesh carry."""
        return self.add("ShaderNodeAttribute", attribute_name=name).outputs["Factor"]


def volume(nodes: Nodes, medium: Any, unit: float) -> Any:
    """The medium: a node for each lobe, or for each lobe and channel where the lobe's mean cosine differs."""
    total, absorption = None, medium.absorption
    for scattering, g in medium.lobes:
        for share, cosine in [(np.ones(3), g[0])] if np.ptp(g) == 0 else zip(np.eye(3), g, strict=True):
            inputs = {
                "Absorption Coefficients": absorption / unit,
                "Scatter Coefficients": share * scattering / unit,
                "Anisotropy": cosine,
            }
            lobe = nodes.add("ShaderNodeVolumeCoefficients", inputs, phase="HENYEY_GREENSTEIN")
            total = lobe if total is None else nodes.add("ShaderNodeAddShader", {0: total, 1: lobe})
            absorption = np.zeros(3)
    return total


def boundary(nodes: Nodes, body: Any, look: Look) -> Any:
    """The surface, or None where light passes as if there were none.

    Light that passes a thin boundary goes straight on, and the share that Fresnel's equations give for a ray from
    outside is mirrored, on both sides. A surface of glass refracts instead.
    """
    contrast = any(side.ior != 1 for side in body.sides)
    if not (contrast or any(body.stains) or look.highlight is not None):
        return None
    ior, outside = nodes.attribute("ior"), nodes.attribute("outside")
    behind = nodes.add("ShaderNodeNewGeometry").outputs["Backfacing"]
    white = (1.0, 1.0, 1.0, 1.0)
    through = nodes.add("ShaderNodeBsdfTransparent", {"Color": white})
    if any(body.stains):
        passed: list[Any] = [1.0, 1.0, 1.0]
        for k, path in enumerate(body.stains):
            if path is not None:
                image = bpy.data.images.load(str(path), check_existing=True)
                image.colorspace_settings.name = "Non-Color"
                image.pack()
                texture = nodes.add("ShaderNodeTexImage", image=image, interpolation="Linear", extension="EXTEND")
                passed[k] = nodes.math("SUBTRACT", 1.0, nodes.math("MULTIPLY", texture, outside))
        colour = nodes.add("ShaderNodeCombineColor", dict(enumerate(passed)))
        nodes.tree.links.new(colour.outputs[0], through.inputs["Color"])
    surface = through
    if contrast and look.surface == "glass":
        inside = nodes.math("COMPARE", ior, 1.0, 1e-5)
        inputs = {"Color": white, "IOR": ior, "Roughness": look.roughness}
        glass = nodes.add("ShaderNodeBsdfGlass", inputs, distribution=look.distribution)
        surface = nodes.add("ShaderNodeMixShader", {0: inside, 1: glass, 2: through})
    elif contrast:
        # A ray from inside would get the share of the inverse index.
        index = nodes.math("POWER", ior, nodes.math("MULTIPLY_ADD", behind, -2.0, 1.0))
        share = nodes.add("ShaderNodeFresnel", {"IOR": index})
        mirror = nodes.add("ShaderNodeBsdfGlossy", {"Color": white, "Roughness": look.roughness}, distribution="GGX")
        surface = nodes.add("ShaderNodeMixShader", {0: share, 1: through, 2: mirror})
    if look.highlight is not None:
        front = nodes.math("MULTIPLY", outside, nodes.math("SUBTRACT", 1.0, behind))
        share = nodes.math("MULTIPLY", nodes.add("ShaderNodeFresnel", {"IOR": TOOTH_IOR}), front)
        shine = nodes.add("ShaderNodeBsdfGlossy", {"Color": share, "Roughness": look.highlight}, distribution="GGX")
        surface = nodes.add("ShaderNodeAddShader", {0: surface, 1: shine})
    return surface


def subsurface(nodes: Nodes, medium: Any, unit: float) -> Any:
    """Principled shader for front light and distant shots: the dentin's scattering as a random walk below the surface.

    The colour is the reflectance of a half space of the reduced albedo (van de Hulst, Multiple Light Scattering, 1980).
    """
    total = medium.scattering_reduced + medium.absorption
    absorbed = np.divide(medium.absorption, total, out=np.zeros(3), where=total > 0) ** 0.5
    colour = (1 - absorbed) * (1 - 0.139 * absorbed) / (1 + 1.17 * absorbed)
    radius = np.divide(RADIUS_FACTOR * unit, total, out=np.zeros(3), where=total > 0)
    inputs = {
        "Base Color": (*colour, 1.0),
        "Subsurface Weight": 1.0,
        "Subsurface Radius": radius / max(radius.max(), 1e-30),
        "Subsurface Scale": radius.max(),
        "Subsurface Anisotropy": 0.0,
        "Specular IOR Level": 0.0,
    }
    return nodes.add("ShaderNodeBsdfPrincipled", inputs, subsurface_method="RANDOM_WALK")


def fill(material: Any, body: Any, look: Look, unit: float) -> None:
    """Give a material the body's medium and surface.

    Args:
        unit: Blender units per mm.
    """
    nodes = Nodes(material)
    output = nodes.add("ShaderNodeOutputMaterial")
    if look.subsurface:
        shaders = {"Surface": subsurface(nodes, body.medium, unit)}
    else:
        shaders = {
            "Volume": volume(nodes, body.medium.absorbing(look.absorption), unit),
            "Surface": boundary(nodes, body, look),
        }
    for name, shader in shaders.items():
        if shader is not None:
            nodes.tree.links.new(shader.outputs[0], output.inputs[name])
