"""The time of a slab's fit on one worker and on two, in turns, on an idle machine of two cores; about 25 minutes.

python -m tests.benchmarks.slab_workers --pairs 3 --json slab_workers.json

The cell of all slab benchmarks is fitted with two wavelengths, each of which runs whole on one worker, with one
wavelength, whose blocks of paths both workers share, and with three, of which two run whole and the third is shared.
Seconds are elapsed time from the submission of the fit's stage to its report; both clusters have run a short fit
before, so that nothing is compiled in the measured ones. The efficiency is the time on one worker over twice the time
on two. Results must agree to the last digit. The file keeps the pairs of an earlier run, and a new run continues after
them.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from services.bench.slab.cell import near_beam_folder
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.slab.cell.dictionary import henyey_greenstein
from services.slab.cell.forward import render
from services.slab.cell.rig import rig_of
from services.slab.results.result import SlabReport

MEDIA = {532.0: (1.0, 0.8, 0.03), 635.0: (0.8, 0.7, 0.02), 488.0: (1.2, 0.8, 0.04)}
"""Scattering per mm, mean cosine and absorption per mm by wavelength, nm."""
NOISE = 0.01
TRUTH_PATHS = 4_000_000
"""Number of paths per light of the images, so that their own noise is small beside the shot noise: with 200,000 the fit
met images of far more noise than they stated, and lost its way."""
WARMING_EFFORT = 0.01


def write_cell(root: Path, *wavelengths_nm: float) -> Path:
    """Write a folder of the cell with images by the fit's own walk and shot noise of 1 %; returns its path."""
    root.mkdir()
    noise = np.random.default_rng(1)
    folder = near_beam_folder()
    description, entries = folder.model_dump(mode="json") | {"wavelengths_nm": list(wavelengths_nm)}, []
    rig = rig_of(folder, folder.wavelengths_nm[0])
    for nm in wavelengths_nm:
        images = render(
            rig, henyey_greenstein(*MEDIA[nm]), seed=99, step=0, batches=1, paths=TRUTH_PATHS, scores=False
        ).mean
        for entry, image in zip(description["images"], images, strict=True):
            half = image.reshape(rig.grid.rows, rig.grid.columns)
            whole = np.concatenate([half[::-1], half])
            file = f"{nm:g}_{entry['file']}"
            np.save(root / file, whole + NOISE * np.sqrt(whole * whole.mean()) * noise.normal(size=whole.shape))
            entries.append({"camera": entry["camera"], "light": entry["light"], "wavelength_nm": nm, "file": file})
    (root / "slab.json").write_text(json.dumps(description | {"images": entries}))
    return root


@contextmanager
def workers(count: int) -> Iterator[Any]:
    """A client of a cluster of ``count`` workers of one thread."""
    import dask
    from distributed import Client, LocalCluster

    from services.pipeline.dask_config import DASK_CONFIG

    with (
        dask.config.set({**DASK_CONFIG, "distributed.worker.daemon": False}),
        LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def fitted(client: Any, cell: Path, count: int, effort: float) -> tuple[float, SlabReport]:
    """Elapsed seconds of the fit stage, and its report."""
    options = {"kind": "slab", "capture": cell, "effort": effort, "workers": count}
    with tempfile.TemporaryDirectory() as root:
        began_s = time.monotonic()
        report: SlabReport = client.submit(_stage, JobSpec.model_validate(options), Path(root), pure=False).result()
        return time.monotonic() - began_s, report


def _stage(spec: JobSpec, root: Path) -> SlabReport:
    # Runs on a worker; the fit spreads its blocks from there.
    from services.slab.stage import run

    return run(spec, LocalContext(root))


def numbers(report: SlabReport) -> list[Any]:
    """The results that must not depend on the workers."""
    return [(fit.parameters, fit.phase, fit.errors) for fit in report.fits]


def summary(rows: list[dict[str, Any]]) -> str:
    """Text with the median and range of each case's efficiency."""
    lines = []
    for name in dict.fromkeys(row["case"] for row in rows):
        own = [row for row in rows if row["case"] == name]
        found = sorted(row["one_s"] / (2 * row["two_s"]) for row in own)
        same = all(row["same"] for row in own)
        lines.append(
            f"{name}, {len(found)} pairs: {100 * np.median(found):.0f} % ({100 * found[0]:.0f} to {100 * found[-1]:.0f}"
            f" %), answers {'the same' if same else 'DIFFER'}"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the pairs of all cases in turns, and swap the order of one and two workers each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--effort", type=float, default=1.0)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(arguments.json.read_text()) if arguments.json.exists() else []
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        cells = {
            "two wavelengths": write_cell(Path(name) / "two", *list(MEDIA)[:2]),
            "blocks of one": write_cell(Path(name) / "one", next(iter(MEDIA))),
            "three wavelengths": write_cell(Path(name) / "three", *MEDIA),
        }
        clusters = {count: stack.enter_context(workers(count)) for count in (1, 2)}
        for count, client in clusters.items():
            for cell in cells.values():
                fitted(client, cell, count, WARMING_EFFORT)
        for pair in range(arguments.pairs):
            for case, cell in cells.items():
                if any(row["case"] == case and row["pair"] == pair for row in rows):
                    continue
                idle = (os.cpu_count() or 1) - os.getloadavg()[0]
                order = (1, 2) if pair % 2 == 0 else (2, 1)
                found = {count: fitted(clusters[count], cell, count, arguments.effort) for count in order}
                rows.append(
                    {
                        "case": case,
                        "pair": pair,
                        "one_s": found[1][0],
                        "two_s": found[2][0],
                        "idle_cores": idle,
                        "same": numbers(found[1][1]) == numbers(found[2][1]),
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
                arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(summary(rows))


if __name__ == "__main__":
    main()
