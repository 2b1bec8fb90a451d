"""The OpenPBR materials of an asset as a MaterialX document (``.mtlx``, version 1.39)."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

from services.assets.appearance import Appearance, open_pbr_inputs
from services.assets.usd.text import number

VERSION = "1.39"


def document(looks: Mapping[str, Appearance], note: str) -> bytes:
    """A material for each name, in scene-linear colours with the primaries of Rec. 709; lengths are mm."""
    root = ElementTree.Element("materialx", version=VERSION, colorspace="lin_rec709", doc=note)
    for name, look in looks.items():
        shader = ElementTree.SubElement(root, "open_pbr_surface", name=f"{name}_surface", type="surfaceshader")
        for key, (kind, value) in open_pbr_inputs(look).items():
            text = number(value) if isinstance(value, float) else ", ".join(map(number, value))
            ElementTree.SubElement(shader, "input", name=key, type=kind, value=text)
        material = ElementTree.SubElement(root, "surfacematerial", name=name, type="material")
        ElementTree.SubElement(
            material, "input", name="surfaceshader", type="surfaceshader", nodename=f"{name}_surface"
        )
    ElementTree.indent(root)
    return b'<?xml version="1.0"?>\n' + ElementTree.tostring(root) + b"\n"
