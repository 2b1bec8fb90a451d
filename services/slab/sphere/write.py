"""Write a folder of results: ``parameters.json``, ``readings.json`` and, for a spectrum, ``translucency.json``."""

from __future__ import annotations

import json
from pathlib import Path

from services.core.store import write_atomic
from services.slab.sphere.invert import Fitted
from services.slab.sphere.translucency import Translucency

PARAMETERS = ("sigma_a", "sigma_s_reduced", "g", "sigma_s", "sigma_t", "absorption_ratio")


def write_sphere(out: Path, fits: list[Fitted], translucency: Translucency | None) -> None:
    """Write the results by wavelength, in the form that a fit of images has."""
    out.mkdir(parents=True, exist_ok=True)
    results = [fitted.fit.model_dump() for fitted in fits]
    parameters = {fit["name"]: {name: fit[name] for name in PARAMETERS if fit[name] is not None} for fit in results}
    readings = {
        fit["name"]: {name: value for name, value in fit.items() if name not in {*PARAMETERS, "name"}}
        for fit in results
    }
    files = {"parameters": parameters, "readings": readings}
    if translucency is not None:
        files["translucency"] = translucency.model_dump()
    for name, value in files.items():
        write_atomic(out / f"{name}.json", json.dumps(value, indent=1).encode())
