"""The content of a slab's asset: a plate of the measured material, as thick as the cell was."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydantic import TypeAdapter, ValidationError

from services.assets.content import AssetContent, AssetPart
from services.assets.people_mesh import people_mesh
from services.core.errors import CorruptStoreError
from services.core.geometry import Mesh
from services.core.results import AssetManifest, Estimate

NAME = "slab"
"""Name of the part, and of its tissue."""
FIELDS = ("sigma_t", "sigma_s", "sigma_a", "sigma_s_reduced", "g", "index")
"""Coefficients of a wavelength in a slab's ``parameters.json``."""


def is_slab(folder: Path) -> bool:
    """Whether an asset's folder is a slab's."""
    return any(folder.glob("slab_*.xml"))


def read_slab(job: Path, folder: Path, manifest: AssetManifest) -> AssetContent:
    """The content of the asset of a slab; its wavelengths are the channels.

    Raises:
        CorruptStoreError: the coefficients or a scene cannot be read.
    """
    path = job / "parameters.json"
    try:
        read: Mapping[str, Mapping[str, Any]] = json.loads(path.read_bytes())
        tables = TypeAdapter(dict[str, dict[str, Estimate]]).validate_python(
            {channel: {name: table[name] for name in FIELDS} for channel, table in read.items()}
        )
    except (OSError, ValueError, KeyError, ValidationError) as problem:
        raise CorruptStoreError(f"{path} cannot be read; write it again with dentine export.") from problem
    estimates = {channel: table | _as_medium(table) for channel, table in tables.items()}
    surface = _plate(_half_lengths_mm(min(folder.glob("slab_*.xml"))))
    part = AssetPart(NAME, NAME, None, surface, people_mesh(surface), estimates)
    ior = float(np.mean([table["index"].value for table in tables.values()]))
    return AssetContent((part,), tuple(tables), manifest.converged, folder, ior)


def _as_medium(table: Mapping[str, Estimate]) -> dict[str, Estimate]:
    # The names of a tooth's medium; the phase function becomes one lobe of the same mean cosine.
    sigma, share = table["sigma_t"], table["sigma_s"].value / table["sigma_t"].value
    alpha = Estimate(value=min(share, 1.0), se=None, unit="1", determined=table["sigma_s"].determined)
    return {"sigma": sigma, "alpha": alpha, "g1": table["g"]}


def _half_lengths_mm(scene: Path) -> np.ndarray:
    try:
        scale = ElementTree.parse(scene).find(".//shape/transform/scale")  # noqa: S314 - a file of this program
        assert scale is not None
        return np.array([float(scale.attrib[axis]) for axis in "xyz"])
    except (ElementTree.ParseError, AssertionError, KeyError, ValueError) as problem:
        raise CorruptStoreError(f"{scene} has no plate; write it again with dentine export.") from problem


def _plate(half_lengths_mm: np.ndarray) -> Mesh:
    """A box whose six sides share no vertices, so that its edges stay sharp."""
    import trimesh

    box = trimesh.creation.box(2 * half_lengths_mm)
    sides = np.asarray(box.facets)  # the two triangles of each side
    vertices, faces = [], []
    for k, side in enumerate(sides):
        used, index = np.unique(box.faces[side], return_inverse=True)
        vertices.append(box.vertices[used])
        faces.append(index.reshape(-1, 3) + 4 * k)
    return Mesh(np.concatenate(vertices).astype(np.float64), np.concatenate(faces).astype(np.int32))
