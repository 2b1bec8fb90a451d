"""What a surface material costs: an incisor's USD and glTF as Cycles shows them, against its media by the same program.

make clients
python -m tests.benchmarks.surface_materials --json surfaces.json [--paths 512] [--seeds 2]

A row for each format and light holds the imported picture ÷ that of the media (mean over the tooth, by channel), its
standard error from the seeds, and the median and 95th percentile of ΔE00 over pixels of 1 mm. White is the brightest
percentile of the media's picture under that light.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.assets.exporters import export_to
from services.core.files.meshes import read_mesh
from services.core.geometry import Light
from services.core.results import AssetManifest
from services.core.store import StageWriter, write_atomic
from services.transport.platform import prepare_device
from tests.benchmarks.cycles import RGB, TRUTH
from tests.support.clients import run_client
from tests.support.cycles_scenes import LAMP, Case, cycles_image, ratio_of, write_case
from tests.support.small_tooth import camera_at

FILES = {"usd": "asset.usda", "gltf": "asset.gltf"}
BEHIND = Light(name="l0", position_mm=(-150.0, -600.0, 250.0), intensity=(1e6, 1e6, 1e6))
Array = NDArray[np.float64]


def cases() -> dict[str, Case]:
    """The incisor in three channels under even light, a lamp before it, and a lamp behind it."""
    outer, dentin = (read_mesh(TRUTH / "teeth" / "11" / f"{name}.ply") for name in ("outer", "dentin"))
    front = Case(outer, dentin, RGB, camera_at((0.2, 1.0, 0.15), size=16, span_mm=16.0))
    return {
        "sky": front,
        "lamp before it": replace(front, lit_by="lamp", lamp=LAMP),
        "lamp behind it": replace(front, lit_by="lamp", lamp=BEHIND),
    }


def imported_image(job: Path, name: str, case: Case, paths: int, seed: int) -> Array:
    """Radiance (H, W, 3) of an imported file."""
    import mitsuba as mi

    picture = job / f"{name}-{seed}.exr"
    light, sky = ("none", "1") if case.lit_by == "sky" else (case.lamp.name, "0")
    script = Path(__file__).parents[1] / "clients" / "render_import.py"
    words = (job / f"asset-{name}" / FILES[name], job / "asset-blender", picture, light, sky, str(paths), str(seed))
    done = run_client("bpy", script, *words)
    assert done.returncode == 0, done.stderr
    return np.array(mi.Bitmap(str(picture)), dtype=np.float64)[..., :3]


def differences(image: Array, truth: Array, covered: NDArray[np.bool_]) -> Array:
    """ΔE00 (N,) of linear sRGB pixels, white being the 99th percentile of the truth."""
    import colour

    white = np.percentile(truth[covered], 99)
    lab = [
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(one[covered] / white, 0, None), "sRGB")) for one in (image, truth)
    ]
    return np.asarray(colour.delta_E(lab[0], lab[1], method="CIE 2000"))


def rows_of(light: str, case: Case, paths: int, seeds: int) -> list[dict[str, Any]]:
    """Render one light, and compare each format."""
    with TemporaryDirectory() as place:
        job = Path(place)
        writer = StageWriter(job, "asset", 1)
        write_case(writer.folder, case)
        writer.publish(AssetManifest(files=()))
        export_to(job, (*FILES, "blender"))
        truth = np.stack([cycles_image(job / "asset-blender", case, paths, seed) for seed in range(seeds)])
        rows = []
        for name in FILES:
            found = np.stack([imported_image(job, name, case, paths, seed) for seed in range(seeds)])
            ratio = ratio_of(found, truth, case.covered())
            delta = np.percentile(differences(found.mean(axis=0), truth.mean(axis=0), case.covered()), [50, 95])
            rows.append(
                {
                    "format": name,
                    "light": light,
                    "ratio": ratio.value.round(4).tolist(),
                    "se": ratio.se.round(4).tolist(),
                    "delta_e": dict(zip(("median", "p95"), delta.round(2).tolist(), strict=True)),
                    "paths": paths,
                    "seeds": seeds,
                }
            )
        return rows


def main() -> None:
    """Render and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--paths", type=int, default=512)
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    prepare_device()
    rows: list[dict[str, Any]] = []
    for light, case in cases().items():
        rows += rows_of(light, case, options.paths, options.seeds)
        write_atomic(options.json, (json.dumps(rows, indent=1) + "\n").encode())
        print(json.dumps(rows[-len(FILES) :]), flush=True)


if __name__ == "__main__":
    main()
