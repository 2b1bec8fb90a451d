"""How far a roughness by highlights is off, and how honest its standard error is.

python -m tests.benchmarks.roughness --json roughness.json

Highlights are stock Mitsuba's, of the micro-CT incisor (0.1 mm pixels, 3 cameras, 8 lights). The light beneath is that
of its index-matched capture by stock Mitsuba, enlarged. Each seed draws twelve of the 24 photographs, noise of 1 % at
an image's mean, and an error of the scan of 0.02 mm with a correlation length of 1 mm. The second part gives an
ellipsoid's scan ever larger triangles, with normals interpolated between vertices and with those of its facets. A row
takes some 8 seconds of one core; rows that the file holds already are kept.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.files.meshes import read_mesh
from services.core.geometry import Mesh
from services.core.records import FolderCapture
from services.core.store import read_record
from services.fit.measurements.levels import finer_camera
from services.fit.measurements.roughness.measure import Roughness, roughness_from_highlights
from services.fit.measurements.roughness.patches import Photograph
from tests.support.glossy_bodies import IOR, body, photograph, photographed, reflected_once, render, scanned
from tests.support.shared_data import shared_path

ROUGHNESS = (0.05, 0.1, 0.15, 0.3)
FINER = 5
"""Pixels in place of one of the capture's, along each edge."""
PHOTOGRAPHS = 12
SAMPLES = 64
FACETS = (5, 4, 3)
"""Subdivisions of the ellipsoid's scan: edges of 0.2, 0.4 and 0.8 mm."""


def main() -> None:
    """Measure each roughness, seed and scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--roughness", type=float, nargs="*", default=ROUGHNESS)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows: dict[str, Any] = json.loads(options.json.read_text()) if options.json and options.json.is_file() else {}

    def keep(name: str, found: Roughness, truth: float) -> None:
        rows[name] = {
            "error": found.value / truth - 1,
            "se": found.standard_error / truth,
            "brightness": found.brightness,
            "brightness_se": found.brightness_se,
            "warnings": found.warnings,
        }
        print(name, rows[name], flush=True)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1))

    for truth in options.roughness:
        for seed in range(options.seeds):
            if (name := f"incisor {truth:g} {seed}") not in rows:
                keep(
                    name, roughness_from_highlights(scanned(incisor(), 0.02, 1.0, seed), drawn(truth, seed), IOR), truth
                )
        own = [row for name, row in rows.items() if name.startswith(f"incisor {truth:g} ")]
        print(truth, "rms error", rms([row["error"] for row in own]), "rms z", rms([z_of(row) for row in own]))
    told = [z_of(row) for name, row in rows.items() if name.startswith("incisor")]
    print("rms z of all", rms(told), "of", len(told))
    for truth in (0.1, 0.3):
        for subdivisions in FACETS:
            for kind, mesh in (("smooth", body(subdivisions)), ("facets", apart(body(subdivisions)))):
                if (name := f"ellipsoid {truth:g} {subdivisions} {kind}") not in rows:
                    keep(name, roughness_from_highlights(mesh, photographed(glossy(truth), seed=1), IOR), truth)


def z_of(row: dict[str, Any]) -> float:
    return float(row["error"] / row["se"])


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@cache
def glossy(roughness: float) -> NDArray[np.float64]:
    return render(roughness) + render(None)


def apart(mesh: Mesh) -> Mesh:
    """A mesh whose triangles share no vertex, so that its normals are those of the facets."""
    return Mesh(
        mesh.vertices_mm[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    )


@cache
def incisor() -> Mesh:
    return read_mesh(shared_path("data/tooth-ur1-truth") / "teeth" / "11" / "outer.ply")


@cache
def capture() -> FolderCapture:
    return read_record(shared_path("data/tooth-ur1-truth") / "capture.json", FolderCapture)


@cache
def images(roughness: float) -> NDArray[np.float64]:
    """Radiance (cameras, lights, H, W) of the incisor: its highlights and the light beneath."""
    from scipy.ndimage import gaussian_filter, zoom

    root, found = shared_path("data/tooth-ur1-truth"), []
    for c, coarse in enumerate(capture().cameras):
        camera = finer_camera(coarse, FINER)
        for k, light in enumerate(capture().lights):
            path = root / "teeth" / "11" / "outer.ply"
            highlight = reflected_once(path, camera, light, roughness, SAMPLES, seed=10 * c + k)
            beneath = np.load(root / f"c{c}_l{k}.npy").squeeze()
            # Take out the capture's noise, and spread its values beyond the outline, before they are enlarged
            seen = (beneath > 1e-6 * beneath.max()).astype(float)
            smooth = gaussian_filter(beneath * seen, 0.8) / np.maximum(gaussian_filter(seen, 0.8), 1e-3)
            large = np.maximum(zoom(smooth, FINER, order=3, mode="nearest", grid_mode=True), 0)
            found.append(highlight + large)
    return np.array(found).reshape(len(capture().cameras), len(capture().lights), *found[0].shape)


def drawn(roughness: float, seed: int) -> list[Photograph]:
    """Photographs of one seed."""
    random, found = np.random.default_rng(seed), []
    whole = images(roughness)
    chosen = random.choice(whole.shape[0] * whole.shape[1], PHOTOGRAPHS, replace=False)
    for c, k in (divmod(int(number), whole.shape[1]) for number in np.sort(chosen)):
        camera = finer_camera(capture().cameras[c], FINER)
        found.append(photograph(whole[c, k], camera, capture().lights[k], random))
    return found


if __name__ == "__main__":
    main()
