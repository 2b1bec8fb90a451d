"""Dask's own commands get the same settings as workers that a server starts."""

import json
import os
import subprocess
import sys

from services.pipeline.dask_config import DASK_CONFIG, as_environment

ASK = "import dask, distributed, json, sys; print(json.dumps([dask.config.get(name) for name in sys.argv[1:]]))"


def test_dask_reads_from_the_environment_what_it_is_told() -> None:
    answer = subprocess.run(
        [sys.executable, "-c", ASK, *DASK_CONFIG],
        env=os.environ | as_environment(),
        capture_output=True,
        check=True,
        text=True,
    )
    assert json.loads(answer.stdout) == list(DASK_CONFIG.values())
