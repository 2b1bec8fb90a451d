"""What an exporter is given: the measured parts of a published asset, by name, with surfaces and estimates."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from services.assets.people_mesh import PeopleMesh, mapped_people_mesh, people_mesh
from services.core.errors import CorruptStoreError, MissingStageError
from services.core.files.meshes import fdi_numbers, read_mesh, read_teeth, read_texture_coordinates
from services.core.geometry import OBJECT, Mesh, teeth_folder
from services.core.results import AssetManifest, Estimate
from services.core.store import open_stage
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium

RGB = ("red", "green", "blue")
"""Names of the channels that are taken for the three colours, in their order."""
TEXEL_MM = 0.1
"""Largest edge of a texel on a tooth, mm: finer than stains (0.5 to 1 mm) and changes of the thickness, so that nothing
that was measured is lost."""
TOOTH_IOR = 1.631
"""Refractive index of enamel (teeth 2018), where the asset names none."""
Tables = dict[str, dict[str, Estimate]]


@dataclass(frozen=True)
class AssetPart:
    """One surface of an asset and the estimates of what it bounds."""

    name: str
    """``tooth_11_enamel``, ``tooth_11_dentin``, ``gums``, ``cavity``, ``object_body`` or ``object_core``."""
    tissue: str
    """``enamel``, ``dentin``, ``gums``, ``cavity``, ``body`` or ``core``."""
    fdi: int | None
    """Number of the tooth; None for all others."""
    surface: Mesh
    """The closed surface as it was fitted, mm; a wall of the mouth may be open."""
    mesh: PeopleMesh
    """The same surface with normals and texture coordinates."""
    estimates: Mapping[str, Mapping[str, Estimate]]
    """Channel -> ``sigma``, ``alpha``, ``sigma_s_reduced`` ... -> estimate."""
    stains: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Channel -> transmittance (H, W) in the mesh's chart, where stains were fitted."""
    stain_errors: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Channel -> its standard error (H, W), where the fit kept one."""

    def told_estimates(self) -> dict[str, dict[str, Any]]:
        """The estimates as JSON values: channel -> name -> value, se, unit, determined."""
        return {
            channel: {name: estimate.model_dump(exclude={"se_parts"}) for name, estimate in table.items()}
            for channel, table in self.estimates.items()
        }

    def media(self) -> dict[str, Medium]:
        """The scattering medium behind the surface in each channel; empty for a surface that only reflects."""
        values: dict[str, dict[str, Any]] = {
            channel: {field: table[field].value for field in MEDIUM_FIELDS if field in table}
            for channel, table in self.estimates.items()
        }
        return {channel: Medium(**own) for channel, own in values.items() if {"sigma", "alpha"} <= own.keys()}

    def absorption_per_mm(self) -> NDArray[np.float64]:
        """Absorption coefficient, 1/mm, of red, green and blue."""
        found = {channel: (1 - medium.alpha) * medium.sigma for channel, medium in self.media().items()}
        return in_rgb(found, unknown=0.0)

    def scattering_reduced_per_mm(self) -> NDArray[np.float64]:
        """Reduced scattering coefficient, 1/mm, of red, green and blue."""
        return in_rgb({channel: medium.sigma_s_reduced for channel, medium in self.media().items()}, unknown=0.0)

    def base_colour(self) -> NDArray[np.float64]:
        """Linear red, green and blue of the surface under diffuse light: the reflectance of a half space of the medium
        (van de Hulst 1980, section 11.3), or of the wall itself.
        """
        found = {channel: half_space_reflectance(medium) for channel, medium in self.media().items()}
        if not found:
            found = {channel: t["reflectance"].value for channel, t in self.estimates.items() if "reflectance" in t}
        return np.clip(in_rgb(found), 0.0, 1.0)


@dataclass(frozen=True)
class AssetContent:
    """All parts of one asset."""

    parts: tuple[AssetPart, ...]
    channels: tuple[str, ...]
    converged: bool
    """Whether the fit behind the numbers converged."""
    folder: Path
    """Folder of the published asset, whose files are as they were published."""
    ior: float
    """Refractive index of the teeth."""
    alpha: float | None = None
    """GGX roughness of the teeth's surface, where a fit held one."""
    textures: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """What ``textures.json`` says of each part that has textures, by its name; every exporter finds their files in its
    folder."""

    def part(self, name: str) -> AssetPart | None:
        """The part of a name, if there is one."""
        return next((part for part in self.parts if part.name == name), None)

    @property
    def shown_channels(self) -> tuple[str, str, str]:
        """The channels that stand for red, green and blue; the last stands for those that are missing."""
        named = RGB if set(RGB) <= set(self.channels) else (*self.channels, *self.channels[-1:] * 2)
        return named[0], named[1], named[2]

    @property
    def told_colours(self) -> str:
        """A sentence on what the colours are."""
        if set(RGB) <= set(self.channels):
            return "The camera's red, green and blue are taken for linear RGB; no colour matrix is applied."
        return f"All grey: the mean over the channels {', '.join(self.channels)}, which are not red, green and blue."


def read_content(job: Path) -> AssetContent:
    """The content of the asset that a job has published; results of earlier versions are read too.

    Raises:
        MissingStageError: no asset of a tooth, mouth or object is published. CorruptStoreError: a file is not as it was
            published. MeshError: a surface is open or inside out.
    """
    folder, manifest = open_stage(job, "asset", AssetManifest)
    is_object = (teeth_folder(folder, OBJECT) / "outer.ply").is_file()
    if not (is_object or fdi_numbers(folder)):
        raise MissingStageError(
            f"The asset in {job} holds no tooth, object or slab; export a job of kind tooth, jaw, object or slab."
        )
    tables = read_tables(folder)
    parts: list[AssetPart] = []

    def add(name: str, tissue: str, surface: Mesh, fdi: int | None = None) -> None:
        prefixes = (f"{tissue}.",) if fdi is None else (f"{tissue}.", f"{fdi}.{tissue}.")
        place = teeth_folder(folder, fdi) if fdi is not None and tissue == "enamel" else None
        own = {
            channel: {
                full.removeprefix(prefix): estimate
                for prefix in prefixes
                for full, estimate in table.items()
                if full.startswith(prefix)
            }
            for channel, table in tables.items()
        }
        stains, errors = ({}, {}) if place is None else (_stains(place, tables), _stains(place, tables, "_se"))
        charted = None if place is None else read_texture_coordinates(place / "outer.ply")
        if charted is None:
            mesh = people_mesh(surface, None if place is None else TEXEL_MM)
        else:
            mesh = mapped_people_mesh(surface, charted, _size(surface, charted, stains))
        parts.append(AssetPart(name, tissue, fdi, surface, mesh, own, stains, errors))

    if is_object:
        ((body, core),) = [(one.outer, one.dentin) for one in read_teeth(folder, (OBJECT,))]
        for tissue, surface in (("body", body), ("core", core)):
            if surface is not None:
                add(f"object_{tissue}", tissue, surface)
    for tooth in () if is_object else read_teeth(folder):
        for tissue, surface in (("enamel", tooth.outer), ("dentin", tooth.dentin)):
            if surface is not None:
                add(f"tooth_{tooth.fdi}_{tissue}", tissue, surface, tooth.fdi)
    for tissue in ("gums", "cavity"):
        if (folder / f"{tissue}.ply").is_file():
            surface = read_mesh(folder / f"{tissue}.ply")
            surface.require_surface(f"{tissue}.ply")
            add(tissue, tissue, surface)
    rig = folder / "rig.json"
    return AssetContent(tuple(parts), tuple(tables), manifest.converged, folder, _ior(rig), _alpha(rig))


def read_tables(folder: Path) -> Tables:
    """The estimates of an asset's ``parameters.json``, channel -> name -> estimate.

    Raises:
        CorruptStoreError: the file cannot be read.
    """
    path = folder / "parameters.json"
    try:
        return TypeAdapter(Tables).validate_json(path.read_bytes())
    except (OSError, ValidationError) as problem:
        raise CorruptStoreError(f"{path} cannot be read; write it again with dentine export.") from problem


def _stains(place: Path, channels: Iterable[str], kind: str = "") -> dict[str, NDArray[np.float64]]:
    files = {channel: place / f"stain_{channel}{kind}.npy" for channel in channels}
    return {channel: np.load(file).astype(np.float64) for channel, file in files.items() if file.is_file()}


def _size(surface: Mesh, corners_uv: NDArray[np.float64], stains: Mapping[str, NDArray[np.float64]]) -> tuple[int, int]:
    """Height and width of textures in the chart of the stains: theirs, times the whole number that makes texels of at
    most ``TEXEL_MM``.
    """
    height, width = next((stain.shape for stain in stains.values()), (1, 1))
    edge_mm = np.sqrt(np.mean(mapped_people_mesh(surface, corners_uv, (height, width)).texel_edges_mm() ** 2))
    times = max(1, int(np.ceil(edge_mm / TEXEL_MM)))
    return times * height, times * width


def _ior(rig: Path) -> float:
    # Assets of earlier versions may lack the file or the index.
    told = json.loads(rig.read_bytes()).get("ior") if rig.is_file() else None
    return TOOTH_IOR if told is None else float(told)


def _alpha(rig: Path) -> float | None:
    told = json.loads(rig.read_bytes()).get("roughness") if rig.is_file() else None
    return None if told is None else float(told)


def in_rgb(values: Mapping[str, float | NDArray[np.float64]], unknown: float = 0.5) -> NDArray[np.float64]:
    """Red, green and blue (..., 3) of values (...) by channel; a grey, their mean, of other channels.

    Args:
        values: channel -> number, or picture.
        unknown: the grey where there is no channel.
    """
    if set(RGB) <= values.keys():
        return np.stack([values[channel] for channel in RGB], axis=-1)
    grey = np.mean([np.asarray(one) for one in values.values()], axis=0) if values else unknown
    return np.repeat(np.asarray(grey)[..., None], 3, axis=-1)
