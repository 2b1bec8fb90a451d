"""Render the single teeth of ``tests/data/truths`` by stock Mitsuba: teeth and optics of random subjects, 3 cameras and
8 lights of a dome.

python -m tests.benchmarks.render_truths
python -m tests.benchmarks.render_truths --names homogeneous --samples 512
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

from services.anatomy.templates.jaw import build_jaw
from services.core.files.meshes import write_mesh
from services.core.geometry import Mesh
from services.phantom.tooth import write_phantom
from tests.support.truths import FOLDER, pack

PIXEL_MM, CAMERAS, LIGHTS, SAMPLES = 0.5, 3, 8, 1024


@dataclass(frozen=True)
class Case:
    """One tooth."""

    jaw: int
    """Seed of the subject's jaw."""
    fdi: int
    subject: int
    """Seed of the optics."""
    dentin: bool = True


CASES = {
    "central-incisor": Case(jaw=1, fdi=11, subject=1),
    "homogeneous": Case(jaw=4, fdi=11, subject=4, dentin=False),
    "canine": Case(jaw=2, fdi=13, subject=2),
    "premolar": Case(jaw=3, fdi=24, subject=3),
}


def render(case: Case, folder: Path, samples: int, pixel_mm: float = PIXEL_MM) -> Path:
    """Render a case as a folder capture; returns its folder."""
    tooth = build_jaw(case.jaw).tooth(case.fdi)
    files = {"outer": tooth.outer, "dentin": tooth.dentin}
    for name, mesh in files.items():
        write_mesh(folder / f"{name}.ply", Mesh(tooth.frame.canonical_from_world(mesh.vertices_mm), mesh.faces))
    capture = folder / "capture"
    write_phantom(
        capture, pixel_mm=pixel_mm, cameras=CAMERAS, lights=LIGHTS, samples=samples, seed=case.subject,
        subject=case.subject, renderer="mitsuba", outer=folder / "outer.ply",
        dentin=folder / "dentin.ply" if case.dentin else None,
    )  # fmt: skip
    return capture


def main() -> None:
    """Render and store the chosen cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", default=",".join(CASES), help="cases, separated by commas")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="paths per pixel and light")
    parser.add_argument("--pixel-mm", type=float, default=PIXEL_MM, help="size of a pixel on the tooth")
    parser.add_argument("--out", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names.split(","):
        with tempfile.TemporaryDirectory() as folder:
            pack(
                render(CASES[name], Path(folder), arguments.samples, arguments.pixel_mm), arguments.out / f"{name}.npz"
            )
        print(name, (arguments.out / f"{name}.npz").stat().st_size)


if __name__ == "__main__":
    main()
