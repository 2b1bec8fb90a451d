"""The OpenPBR materials of an asset as a MaterialX document (``.mtlx``, version 1.39)."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

from services.assets.surface_material import Appearance, open_pbr_inputs
from services.assets.usd.text import number

VERSION = "1.39"


def document(looks: Mapping[str, Appearance], note: str) -> bytes:
    """A material for each name, in scene-linear colours with the primaries of Rec. 709; lengths are mm."""
    root = ElementTree.Element("materialx", version=VERSION, colorspace="lin_rec709", doc=note)
    for name, look in looks.items():
        if look.picture is not None:
            _add_picture(root, name, look.picture)
        shader = ElementTree.SubElement(root, "open_pbr_surface", name=f"{name}_surface", type="surfaceshader")
        for key, (kind, value) in open_pbr_inputs(look).items():
            told = {"name": key, "type": kind}
            if isinstance(value, str):
                told |= {"nodegraph": f"{name}_picture", "output": "out"}
            else:
                told["value"] = number(value) if isinstance(value, float) else ", ".join(map(number, value))
            ElementTree.SubElement(shader, "input", told)
        material = ElementTree.SubElement(root, "surfacematerial", name=name, type="material")
        ElementTree.SubElement(
            material, "input", name="surfaceshader", type="surfaceshader", nodename=f"{name}_surface"
        )
    ElementTree.indent(root)
    return b'<?xml version="1.0"?>\n' + ElementTree.tostring(root) + b"\n"


def _add_picture(root: ElementTree.Element, name: str, picture: str) -> None:
    """A graph whose output is the colour of a picture at the texture coordinates ``st``."""
    graph = ElementTree.SubElement(root, "nodegraph", name=f"{name}_picture")
    places = ElementTree.SubElement(graph, "geompropvalue", name="places", type="vector2")
    ElementTree.SubElement(places, "input", name="geomprop", type="string", value="st")
    image = ElementTree.SubElement(graph, "image", name="colour", type="color3")
    file = {"name": "file", "type": "filename", "value": picture, "colorspace": "srgb_texture"}
    ElementTree.SubElement(image, "input", file)
    ElementTree.SubElement(image, "input", name="texcoord", type="vector2", nodename="places")
    ElementTree.SubElement(graph, "output", name="out", type="color3", nodename="colour")
