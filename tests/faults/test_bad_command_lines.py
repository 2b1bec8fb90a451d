"""Wrong command lines end with one sentence on standard error and an exit status, never with a traceback."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from services.api import server
from services.api.captures.contents import content_fault
from services.cli.dask import require_scheduler_named
from services.core.errors import PlatformError, SettingsError
from services.core.settings import ServerSettings, UploadLimits, read_settings
from tests.support.command_line import dentine
from tests.support.mouth import write_mouth

PATIENCE_S = 280.0
"""Time limit of a call that ends by itself, long enough for a busy machine."""
AT_WORK_S = 30.0
"""Time after which a random call that still runs counts as accepted, and is ended."""


def call(
    *arguments: str,
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
    patience_s: float = PATIENCE_S,
) -> tuple[int | None, str]:
    """Exit status and standard error of one call; the status is None if it still ran after ``patience_s``."""
    command = [sys.executable, "-m", "services", *arguments]
    where = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])} | dict(environment or {})
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=where, cwd=folder
    ) as process:
        try:
            told = process.communicate(timeout=patience_s)[1]
        except subprocess.TimeoutExpired:
            process.terminate()
            return None, process.communicate()[1]
    return process.returncode, told


def job(folder: Path, capture: str = "/nowhere") -> str:
    (folder / "JOB.toml").write_text(f"capture = {json.dumps(capture)}\n")
    return str(folder / "JOB.toml")


def text(folder: Path, content: str) -> str:
    (folder / "TEXT.toml").write_text(content)
    return str(folder / "TEXT.toml")


def mouth(folder: Path) -> str:
    write_mouth(folder / "mouth", 2)
    return str(folder / "mouth")


BAD: dict[str, tuple[Callable[[Path], list[str]], str]] = {
    "brackets 5,000 deep": (
        lambda folder: ["run", text(folder, "x = " + "[" * 5000 + "]" * 5000), "--out", "out"],
        "nests brackets too deeply",
    ),
    "NUL in a path": (
        lambda folder: ["run", text(folder, 'capture = "a\\u0000b"'), "--out", "out"],
        "'capture' holds the character NUL",
    ),
    "no channel": (
        lambda folder: ["run", text(folder, 'capture = "x"\nchannels = []'), "--out", "out"],
        "'channels' is empty",
    ),
    "results into a file": (lambda folder: ["run", job(folder), "--out", "JOB.toml"], "JOB.toml is a file"),
    "results below a file": (lambda folder: ["run", job(folder), "--out", "JOB.toml/out"], "JOB.toml is a file"),
    "results into the capture": (
        lambda folder: ["run", job(folder, mouth(folder)), "--out", "mouth/out"],
        "mouth/out lies in",
    ),
    "phantom into a file": (lambda folder: ["phantom", "--out", job(folder)], "JOB.toml is a file"),
    "name beyond all file systems": (lambda folder: ["run", job(folder), "--out", "x" * 300], "cannot be a folder"),
    "worker of nobody": (lambda _: ["worker", "--nthreads", "1"], "No scheduler is named"),
    "data that cannot be made": (
        lambda folder: ["serve", "--port", "0", "--data", f"{job(folder)}/data"],
        "cannot use its data folder",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_calls_end_in_one_sentence(case: str, tmp_path: Path) -> None:
    arguments, named = BAD[case]
    answer = dentine(*arguments(tmp_path), folder=tmp_path)
    status, told = answer.returncode, answer.stderr
    assert status in {2, 4}, told
    assert told.startswith("dentine: ")
    assert told.count("\n") == 1, told
    assert named in told


def test_a_group_and_one_of_its_values_are_not_both_set() -> None:
    for both in (
        {"DENTINE__SERVER": "x", "DENTINE__SERVER__PORT": "1"},
        {"DENTINE__SERVER__PORT": "1", "DENTINE__SERVER": "x"},
    ):
        # The variables' order counts, so the settings are read from just these.
        with pytest.raises(SettingsError, match=r"^Setting DENTINE__SERVER") as problem:
            read_settings(both)
        assert "\n" not in problem.value.message


@pytest.mark.parametrize(
    ("arguments", "environment", "is_named"),
    [
        (["tcp://host:8786", "--nthreads", "1"], {}, True),
        (["--nthreads", "1", "host:8786"], {}, True),
        (["--scheduler-file", "file.json"], {}, True),
        (["--scheduler-file=file.json"], {}, True),
        (["--help"], {}, True),
        ([], {"DASK_SCHEDULER_ADDRESS": "tcp://host:8786"}, True),
        (["--nworkers", "2", "--resources", "DOME=1"], {}, False),
        (["host"], {}, False),
    ],
)
def test_a_scheduler_is_named_in_any_of_dasks_ways(
    arguments: list[str], environment: dict[str, str], is_named: bool
) -> None:
    if is_named:
        require_scheduler_named(arguments, environment)
    else:
        with pytest.raises(Exception, match="No scheduler is named"):
            require_scheduler_named(arguments, environment)


@pytest.mark.parametrize(
    "problem", [OSError(28, "No space left on device"), OperationalError("", {}, Exception("database or disk is full"))]
)
def test_a_server_on_a_full_disk_says_so(problem: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise problem

    monkeypatch.setattr(server, "create_app", fail)
    with pytest.raises(
        PlatformError, match=r"cannot use its data folder .* \((No space left|database or disk is full).*free some disk"
    ):
        server.serve(ServerSettings(data=tmp_path / "data", port=0))


@pytest.mark.parametrize("lengths", ["[1e400]", "[1e300]", "[-1e400, 2]", "[[1]]", '["x"]', "[null]", "{}", "[" * 500])
def test_a_stored_array_of_any_shape_is_a_sentence(lengths: str, tmp_path: Path) -> None:
    path = tmp_path / "zarr.json"
    path.write_text(
        '{"node_type": "array", "data_type": "uint16", "chunk_grid": {"configuration": {"chunk_shape":'
        f" {lengths}}}}}}}"
    )
    told = content_fault(path, "capture.zarr/zarr.json", UploadLimits(), frozenset())
    assert told is None or told.endswith(".")
    assert lengths == "{}" or told is not None


COMMANDS: dict[str, tuple[str, ...]] = {
    "run": ("--out", "--workers", "--json"),
    "capture": ("--out",),
    "export": (),
    "phantom": (
        "--out",
        "--jaw",
        "--subject",
        "--scan",
        "--pixel-mm",
        "--cameras",
        "--lights",
        "--held-out",
        "--channels",
        "--samples",
        "--outer",
        "--fdi",
    ),
    "upload": ("--server", "--subject"),
    "submit": ("--server", "--key", "--calibration"),
    "watch": ("--server",),
    "cancel": ("--server",),
    "bench": ("--json", "--case", "--quick"),
    "simulate slab": (
        "--sigma",
        "--alpha",
        "--width",
        "--layers",
        "--g",
        "--ior",
        "--exit-cosines",
        "--ring-edges",
        "--rel-error",
        "--max-seconds",
    ),
    "token create": ("--scope", "--expires-days", "--group", "--data"),
    "token revoke": ("--data",),
    "dome-sim": ("--port", "--lights", "--watchdog-s", "--host"),
    "worker": ("--nthreads",),
    "register": ("--calibration", "--out", "--max-misfit-mm"),
}
WORDS = (
    "", ".", "/", "/dev/null", "/dev/full", "no/such/thing", "JOB.toml", "TEXT.toml", "mouth", "x" * 300, "ä ö", "-1",
    "0", "1e400", "nan", "inf", "-inf", "99999999999999999999",
    "[]", "[[[[", '{"a": 1}', "%s", "--", "http://127.0.0.1:1", "http://[", "tcp://127.0.0.1:1", "red", "11", "99",
    "0.5", "1,2,x", "[{\"sigma\": 1e308}]",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_hundred_calls_of_any_kind(tmp_path: Path) -> None:
    drawn = random.Random(26)
    job(tmp_path, mouth(tmp_path))
    text(tmp_path, "[rig]\nmouth = 'mouth'\nlevel = 1e400\n")
    for _ in range(100):
        name = drawn.choice(list(COMMANDS))
        arguments = name.split()
        for option in drawn.sample(COMMANDS[name], drawn.randint(0, min(3, len(COMMANDS[name])))):
            arguments += [option, drawn.choice(WORDS)]
        arguments += drawn.choices(WORDS, k=drawn.randint(0, 2))
        status, told = call(*arguments, folder=tmp_path, patience_s=AT_WORK_S)
        assert "Traceback" not in told, f"{arguments}: {told}"
        assert status in {None, 0} or told.strip(), f"{arguments} ended with status {status} and no word"
