"""Writer of a scene dictionary as Mitsuba's XML, with parameters that the command line or ``mi.load_file`` may set."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.assets.mitsuba.rgb import Colour
from services.assets.mitsuba.scene import SceneDict
from services.core.store import write_atomic

FORMAT = "3.0.0"
"""Version of Mitsuba's scene format."""
TAGS = {
    "ply": "shape",
    "null": "bsdf",
    "thin_boundary": "bsdf",
    "roughdielectric": "bsdf",
    "diffuse": "bsdf",
    "twosided": "bsdf",
    "mask": "bsdf",
    "bitmap": "texture",
    "uniform": "spectrum",
    "d65": "spectrum",
    "homogeneous": "medium",
    "hg": "phase",
    "blendphase": "phase",
    "perspective": "sensor",
    "hdrfilm": "film",
    "independent": "sampler",
    "box": "rfilter",
    "prbvolpath": "integrator",
    "volpath": "integrator",
    "volpathmis": "integrator",
    "point": "emitter",
    "constant": "emitter",
}
"""Kind of object of each plug-in that the scenes use."""
VALUE_TAGS = {bool: "boolean", int: "integer", float: "float", str: "string"}


@dataclass(frozen=True)
class SceneParameter:
    """Value that the user may set when loading: ``mi.load_file(path, name=value)``."""

    name: str
    default: float | int


@dataclass(frozen=True)
class Spectrum:
    """Values of a quantity at some wavelengths, linear between them."""

    wavelengths_nm: tuple[float, ...]
    values: tuple[float, ...]


def write_scene(path: Path, scene: SceneDict) -> None:
    """Write the scene. File names in it stay unchanged, so give them relative to ``path``."""
    root = ET.Element("scene", version=FORMAT)
    parameters: dict[str, float] = {}
    _collect(scene, parameters)
    for name, default in parameters.items():
        ET.SubElement(root, "default", name=name, value=repr(default))
    for key, value in scene.items():
        if key != "type":
            _append(root, key, value, top=True)
    ET.indent(root)
    write_atomic(path, ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _collect(node: Any, parameters: dict[str, float]) -> None:
    if isinstance(node, SceneParameter):
        parameters[node.name] = node.default
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        _collect(child, parameters)


def _append(parent: ET.Element, name: str, value: Any, *, top: bool = False) -> None:
    if isinstance(value, dict) and value["type"] == "ref":
        ET.SubElement(parent, "ref", name=name, id=value["id"])
    elif isinstance(value, dict) and value["type"] == "rgb":
        _append(parent, name, value["value"])
    elif isinstance(value, dict):
        element = ET.SubElement(parent, TAGS[value["type"]], {"type": value["type"], "id" if top else "name": name})
        for key, child in value.items():
            if key != "type":
                _append(element, key, child)
    elif isinstance(value, np.ndarray):
        transform = ET.SubElement(parent, "transform", name=name)
        ET.SubElement(transform, "matrix", value=" ".join(repr(float(entry)) for entry in value.reshape(-1)))
    elif isinstance(value, list):
        ET.SubElement(
            parent, "point", {"name": name} | {axis: _text(entry) for axis, entry in zip("xyz", value, strict=True)}
        )
    elif isinstance(value, Colour):
        ET.SubElement(parent, "rgb", name=name, value=", ".join(map(repr, value.values)))
    elif isinstance(value, Spectrum):
        pairs = zip(value.wavelengths_nm, value.values, strict=True)
        ET.SubElement(parent, "spectrum", name=name, value=", ".join(f"{nm!r}:{one!r}" for nm, one in pairs))
    elif isinstance(value, SceneParameter):
        ET.SubElement(parent, VALUE_TAGS[type(value.default)], name=name, value=_text(value))
    else:
        ET.SubElement(parent, VALUE_TAGS[type(value)], name=name, value=_text(value))


def _text(value: Any) -> str:
    if isinstance(value, SceneParameter):
        return f"${value.name}"
    return str(value).lower() if isinstance(value, bool) else str(value)
