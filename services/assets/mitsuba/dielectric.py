"""The thin boundary as a dielectric, for renderers that know no other surface that reflects a part of the light."""

from __future__ import annotations

from typing import Any

from services.assets.mitsuba.scene import SceneDict

ROUGHNESS = 0.12
"""Beckmann width of a wet tooth, Mitsuba's usual facets. Those of GGX lose 8 % of an incisor's light; a smooth
dielectric gave the same pictures within their noise."""
ABSORPTION = 0.3
"""Factor on the absorption. From inside, a dielectric of index 1.631 sends back 0.67 of diffuse light and the thin
boundary 0.11, so light stays longer inside, and the absorption that was fitted with the thin boundary is too large."""
DIELECTRIC_SCENE = "scene_dielectric.xml"
"""Name of the file in an asset."""


def as_dielectric(scene: SceneDict) -> SceneDict:
    """A scene of thin boundaries with rough dielectrics of the same index, the media's absorption times ``ABSORPTION``,
    no stains, and an even sky in place of the lamp, as a lamp without size does not shine through a dielectric.

    ``python -m tests.benchmarks.thin_as_glass`` compares the pictures.
    """
    sky = {"type": "constant", "radiance": 1.0}
    return {name: sky if name == "light" else _converted(node) for name, node in scene.items()}


def _converted(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    if node.get("type") == "thin_boundary":
        return {"type": "roughdielectric", "alpha": ROUGHNESS, "int_ior": node["ior"], "ext_ior": 1.0}
    if node.get("type") == "homogeneous":
        scattering = node["sigma_t"] * node["albedo"]
        total = scattering + ABSORPTION * (node["sigma_t"] - scattering)
        return node | {"sigma_t": total, "albedo": scattering / total if total > 0 else node["albedo"]}
    return {key: _converted(value) for key, value in node.items()}
