"""One large file uploaded through a connection that is cut at random places, resumed each time, and verified, as JSON.

python -m tests.benchmarks.upload_resume --bytes 2147483648 --cuts 20 --json upload_resume.json
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from services.cli.client.upload import upload_folder
from services.client.client import Client
from tests.support.cutting_proxy import cutting
from tests.support.live_server import toy_server
from tests.support.uploading import write_capture

BLOCK_BYTES = 16 * 2**20


def write_large(path: Path, size_bytes: int, seed: int) -> None:
    """Write an array of random bytes as a .npy file of this size."""
    rng = np.random.default_rng(seed)
    with path.open("wb") as stream:
        npy.write_array_header_1_0(stream, {"descr": "|u1", "fortran_order": False, "shape": (size_bytes - 128,)})
        assert stream.tell() == 128
        while missing := size_bytes - stream.tell():
            stream.write(rng.bytes(min(BLOCK_BYTES, missing)))


def sha256(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal text."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def peak_bytes(process: int) -> int:
    """Largest resident memory of a process so far."""
    status = Path(f"/proc/{process}/status").read_text()
    return next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def measure(work: Path, size_bytes: int, cuts: int, seed: int) -> dict[str, Any]:
    """Upload a file through a connection that is cut, and verify the stored file."""
    folder = write_capture(work / "capture")
    write_large(folder / "large.npy", size_bytes, seed)
    places = np.random.default_rng(seed).integers(0, size_bytes, cuts).tolist()
    with toy_server(work / "data") as (server, process):
        before = peak_bytes(process.pid)
        assert server.base_url.port is not None
        with cutting(server.base_url.port, places) as proxy, Client(proxy.address) as client:
            began = time.perf_counter()
            uploaded = upload_folder(client, folder)
            seconds = time.perf_counter() - began
        after = peak_bytes(process.pid)
    return {
        "file_bytes": size_bytes,
        "cuts": proxy.cut_count,
        "seconds": round(seconds, 1),
        "sent_over_size": round(proxy.sent_bytes / uploaded.bytes, 4),
        "server_peak_bytes": after,
        "server_peak_before_bytes": before,
        "is_verified": sha256(work / "data" / uploaded.path / "large.npy") == sha256(folder / "large.npy"),
    }


def main() -> None:
    """Read the options, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bytes", type=int, default=2 * 2**30, help="size of the file")
    parser.add_argument("--cuts", type=int, default=20, help="how often the connection is cut")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the JSON here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        text = json.dumps(measure(Path(work), options.bytes, options.cuts, options.seed), indent=1)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
