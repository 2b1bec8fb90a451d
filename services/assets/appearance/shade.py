"""The shade of measured teeth: their colour in the geometry of a guide, and its difference from the guide's tabs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.anatomy.dentin_shape import DentinShape
from services.assets.appearance.guide import Guide
from services.assets.appearance.instrument import APERTURE_MM, Placed, placed, spot_towards
from services.assets.appearance.white import CameraWhite, camera_white
from services.assets.asset import tissue_of
from services.assets.content import RGB, Tables, read_tables
from services.core.colour.cie import delta_e_2000
from services.core.errors import InputError
from services.core.files.meshes import read_teeth
from services.core.geometry import Camera, Record, Tooth
from services.core.results import Estimate
from services.core.store import read_record, sha256_of, write_record
from services.transport.engine import Engine
from services.transport.optics.parameters import Medium
from services.transport.scene.recipe import single_tooth

Floats = NDArray[np.float64]
SHADE = "shade.json"
"""Name of the file in a job's folder; the report shows it."""
NOT_FOR = "Not for choosing or making restorations."
LEFT_OUT = (
    "Standard errors hold those of the fit and of the render, and not those of the camera's colours. Stains and mirror"
    " reflections are left out."
)
SAMPLES = 1024
"""Paths a pixel and channel: the noise is below half a unit of CIELAB over the spot, in a second each."""
DRAWS = 400
"""Number of colours drawn for the standard error of a difference, which is then known to 4 %."""
SEED = 11


class TabDifference(Record):
    """The difference of a tooth from one tab."""

    tab: str
    delta_e_2000: float
    se: float = Field(description="one standard error, of the fit, the render and the tab")


class ToothShade(Record):
    """The colour of one tooth, and its difference from every tab, least first."""

    fdi: int
    lab: tuple[float, float, float] = Field(description="CIELAB under the guide's illuminant")
    lab_se: tuple[float, float, float] = Field(description="one standard error of each, of the fit and the render")
    tabs: tuple[TabDifference, ...]


class Shade(Record):
    """``shade.json``: shades of an asset's teeth against a guide."""

    parameters_sha256: str = Field(description="of the asset's parameters.json, whose media were rendered")
    guide: str = Field(description="name of the guide's file")
    geometry: str
    aperture_mm: float
    illuminant: str
    colours: str = Field(description="where the camera's colours come from")
    teeth: tuple[ToothShade, ...]
    sentences: tuple[str, ...] = Field(description="what the numbers are not, and what they leave out")


def shade_of(asset: Path, guide: Guide, *, samples: int = SAMPLES) -> Shade:
    """Shades of all teeth of a published asset.

    Args:
        asset: folder of the asset.
        guide: the laboratory's guide.
        samples: paths a pixel and channel.

    Raises:
        InputError: the asset has other channels than red, green and blue. CorruptStoreError: a file cannot be read.
    """
    white = camera_white(asset)
    if white is None:
        raise InputError(
            f"The asset in {asset} has other channels than {', '.join(RGB)}, so it has no colour; fit these channels."
        )
    rig = json.loads((asset / "rig.json").read_text(encoding="utf-8"))
    tables = read_tables(asset)
    eye = _mean_eye(rig)
    teeth = tuple(
        _shade(tooth, _of_tooth(tables, tooth.fdi), rig, eye, guide, white, samples) for tooth in read_teeth(asset)
    )
    alone = " Each tooth is seen alone, without gums and neighbours." if len(teeth) > 1 else ""
    where = (
        f"Geometry {guide.geometry}: a spot of {APERTURE_MM:g} mm in the middle of the tooth as the cameras see it; the"
        " light covers the whole tooth."
    )
    return Shade(
        parameters_sha256=sha256_of(asset / "parameters.json"),
        guide=guide.name,
        geometry=guide.geometry,
        aperture_mm=APERTURE_MM,
        illuminant=guide.illuminant,
        colours=white.source,
        teeth=teeth,
        sentences=(NOT_FOR, where + alone, LEFT_OUT),
    )


def write_shade(job: Path, shade: Shade) -> None:
    """Write ``shade.json`` into a job's folder."""
    write_record(job / SHADE, shade)


def read_shade(job: Path, asset: Path) -> Shade | None:
    """The shade that was last computed of a job; None where there is none, or where it is of another asset than this
    one, which was fitted anew since.
    """
    found = read_record(job / SHADE, Shade) if (job / SHADE).is_file() else None
    is_same = found is not None and found.parameters_sha256 == sha256_of(asset / "parameters.json")
    return found if is_same else None


def _shade(
    tooth: Tooth,
    tables: Mapping[str, Mapping[str, Estimate]],
    rig: Mapping[str, Any],
    eye_mm: Floats,
    guide: Guide,
    white: CameraWhite,
    samples: int,
) -> ToothShade:
    at = placed(guide.geometry, spot_towards(tooth.outer, eye_mm))
    shape = None if tooth.dentin is None else DentinShape.known(tooth.dentin)
    recipe = single_tooth(tooth.outer, shape, at.light_positions_mm, at.light_intensities, rig["boundary"], rig["ior"])
    # Only the rig of an asset with a rough surface tells these.
    rough = {name: rig[name] for name in ("roughness", "multiple_scattering") if name in rig}
    engine = Engine(replace(recipe, **rough))
    found = [relative_radiance(engine, dict(tables[channel]), at, samples, shape is not None) for channel in RGB]
    relative, variance = (np.array(values) for values in zip(*found, strict=True))
    draws = np.random.default_rng(SEED).normal(relative, np.sqrt(variance), (DRAWS, 3))
    lab = white.lab(relative[None], guide.illuminant)[0]
    drawn = white.lab(np.maximum(draws, 0.0), guide.illuminant)
    return ToothShade(
        fdi=tooth.fdi,
        lab=_three(lab),
        lab_se=_three(drawn.std(axis=0)),
        tabs=tuple(sorted(_differences(lab, drawn, guide), key=lambda one: one.delta_e_2000)),
    )


def _differences(lab: Floats, drawn: Floats, guide: Guide) -> list[TabDifference]:
    random = np.random.default_rng(SEED + 1)
    found = []
    for tab in guide.tabs:
        tabs = tab.lab + tab.se * random.standard_normal(drawn.shape)
        # About their mean, as draws about a tab of nearly the same colour all differ from it by more than 0.
        spread = delta_e_2000(drawn, tabs)
        value = float(delta_e_2000(lab[None], tab.lab[None])[0])
        found.append(TabDifference(tab=tab.name, delta_e_2000=value, se=float(np.sqrt(np.mean((spread - value) ** 2)))))
    return found


def relative_radiance(
    engine: Engine, table: dict[str, Estimate], at: Placed, samples: int, layered: bool
) -> tuple[float, float]:
    """Mean radiance over the spot relative to a perfect diffuser's, in one channel, with its variance by the render's
    noise and by the errors of the reduced scattering and the absorption, which are taken to be independent.
    """
    tissue = tissue_of(table)
    parts = ("enamel", "dentin") if layered else ("enamel",)
    names = tuple(f"{part}.{field}" for part in parts for field in ("sigma", "alpha"))
    images = engine.images(tissue, at.view, seed=SEED, samples=samples)
    count = images.mean.shape[1]
    value = images.mean.sum(axis=0).mean() / at.white_radiance
    # Lights share paths, so their noise may be equal in sign; the sum of standard errors is the largest that it can be.
    noise = (np.sqrt(images.variance).sum(axis=0) ** 2).sum() / (count * at.white_radiance) ** 2
    slopes = engine.jacobian(tissue, at.view, names, seed=SEED + 1, samples=samples)
    slope = dict(zip(names, slopes.jacobian.sum(axis=1).mean(axis=1) / at.white_radiance, strict=True))
    variance = float(noise)
    for part in parts:
        by_scattering, by_absorption = _by_reduced(
            getattr(tissue, part), slope[f"{part}.sigma"], slope[f"{part}.alpha"]
        )
        for name, derivative in ((f"{part}.sigma_s_reduced", by_scattering), (f"{part}.sigma_a", by_absorption)):
            estimate = table.get(name)
            variance += (derivative * (0.0 if estimate is None else estimate.se or 0.0)) ** 2
    return float(value), variance


def _by_reduced(medium: Medium, by_sigma: float, by_alpha: float) -> tuple[float, float]:
    """Derivatives by reduced scattering and by absorption at a constant mean cosine, from those by sigma and alpha."""
    stretch = 1 / (1 - medium.mean_cosine)
    scattering = stretch * (by_sigma + by_alpha * (1 - medium.alpha) / medium.sigma)
    absorption = by_sigma - by_alpha * medium.alpha / medium.sigma
    return scattering, absorption


def _of_tooth(tables: Tables, fdi: int) -> dict[str, dict[str, Estimate]]:
    return {
        channel: {
            name.removeprefix(f"{fdi}."): estimate
            for name, estimate in table.items()
            if not name.partition(".")[0].isdigit() or name.startswith(f"{fdi}.")
        }
        for channel, table in tables.items()
    }


def _mean_eye(rig: Mapping[str, Any]) -> Floats:
    """Mean position of the asset's cameras, mm."""
    cameras = [Camera(name=name, **view) for name, view in rig["views"].items()]
    poses = [np.array(camera.camera_from_world) for camera in cameras]
    return np.asarray(np.mean([-pose[:3, :3].T @ pose[:3, 3] for pose in poses], axis=0))


def _three(values: Floats) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
