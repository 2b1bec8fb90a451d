"""A small slab rig: one cell, some lights and cameras, and its folder on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from services.core.slab.folder import SlabFolder
from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.slab.cell.rig import Rig, rig_of
from services.slab.results.result import Errors, Parameters, PhaseFunction, Quantity, SlabFit

WAVELENGTH_NM = 532.0
TRUTHS = {532.0: (1.2, 0.6), 635.0: (0.8, 0.4)}
"""Scattering per mm and mean cosine by wavelength in nm."""
ABSORPTION_PER_MM = 0.05


def description(**changes: Any) -> dict[str, Any]:
    """``slab.json`` of a 1 mm cell with a front and a back light and two cameras; top-level keys may be replaced."""
    lights = [{"name": "l0", "side": "front", "angle_deg": 5.0}, {"name": "l1", "side": "back", "angle_deg": 20.0}]
    cameras = [{"name": "f0", "side": "front", "angle_deg": -15.0}, {"name": "b0", "side": "back", "angle_deg": 8.0}]
    told: dict[str, Any] = {
        "kind": "slab",
        "units": "mm",
        "wavelengths_nm": [WAVELENGTH_NM],
        "cell": {"width_mm": 1.0, "index": 1.33, "index_outside": 1.0, "boundary": "smooth", "glass": None},
        "beam": {"profile": "gaussian", "sigma_mm": 0.25, "power": 1.0},
        "pixels": {"x_mm": [-4.0, 4.0], "y_mm": [-4.0, 4.0], "columns": 8, "rows": 8},
        "lights": lights,
        "cameras": cameras,
    }
    told.update(changes)
    told.setdefault(
        "images",
        [
            {"camera": camera["name"], "light": light["name"], "file": f"{camera['name']}_{light['name']}.npy"}
            for light in told["lights"]
            for camera in told["cameras"]
        ],
    )
    return told


def small_rig(**changes: Any) -> Rig:
    """The rig of ``description``."""
    return rig_of(SlabFolder.model_validate(description(**changes)), WAVELENGTH_NM)


def write_folder(root: Path, told: dict[str, Any], image: np.ndarray | None = None) -> Path:
    """Write a slab folder with the same image in every file."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "slab.json").write_text(json.dumps(told))
    pixels = np.full((8, 8), 0.01) if image is None else image
    for entry in told["images"]:
        np.save(root / entry["file"], pixels)
    return root


def write_cell(root: Path, *wavelengths_nm: float) -> Path:
    """Write a cell's folder with two lights, two cameras and 1 % noise; each wavelength's first image is held out."""
    told, noise = description(wavelengths_nm=list(wavelengths_nm)), np.random.default_rng(1)
    shown = [(nm, image) for nm in wavelengths_nm for image in told["images"]]
    told["images"] = [{**image, "wavelength_nm": nm, "file": f"{nm:g}_{image['file']}"} for nm, image in shown]
    for k in range(len(wavelengths_nm)):
        told["images"][k * len(shown) // len(wavelengths_nm)]["held_out"] = True
    described = SlabFolder.model_validate(told)
    for nm in wavelengths_nm:
        rig, medium = rig_of(described, nm), henyey_greenstein(*TRUTHS[nm], ABSORPTION_PER_MM)
        images = render(rig, medium, seed=99, step=0, batches=1, paths=50_000, scores=False).mean
        entries = [image for image in described.images if image.wavelength_nm == nm]
        for entry, image in zip(entries, images, strict=True):
            half = image.reshape(rig.grid.rows, rig.grid.columns)
            whole = np.concatenate([half[::-1], half])
            np.save(root / entry.file, whole + 0.01 * np.sqrt(whole * whole.mean()) * noise.normal(size=whole.shape))
    # The folder does not state the index. It follows from the through-beam, as the cell has no glass.
    sine = described.cell.index_outside * np.sin(np.radians(told["lights"][1]["angle_deg"])) / told["cell"]["index"]
    peak_mm = told["cell"]["width_mm"] * sine / np.sqrt(1 - sine**2)
    told["through_beam"] = [{"light": told["lights"][1]["name"], "peak_x_mm": float(peak_mm), "se_mm": 1e-4}]
    told["cell"] = told["cell"] | {"index": None}
    (root / "slab.json").write_text(json.dumps(told))
    return root


def made_up_fit(wavelength_nm: float = WAVELENGTH_NM) -> SlabFit:
    """A fit's result with made-up values."""
    one = Quantity(value=1.0, se=0.1, unit="1/mm", determined=True)
    parameters = Parameters(sigma_t=one, sigma_s=one, sigma_a=one, sigma_s_reduced=one, g=one, index=one)
    phase = PhaseFunction(theta_deg=(), value_per_sr=(), se_per_sr=(), determined=())
    return SlabFit(
        wavelength_nm=wavelength_nm,
        parameters=parameters,
        phase=phase,
        errors=Errors(fit_error=0.01, held_out_error=None),
        notes=(),
        converged=True,
        steps=1,
        paths=1,
        core_seconds=1.0,
    )
