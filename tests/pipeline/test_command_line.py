"""The command line's interface: exit status, one sentence on standard error, JSON on standard output."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.command_line import dentine
from tests.support.live_server import serving
from tests.support.small_slab import description
from tests.support.toy_stages import run_here


def sentence(answer: subprocess.CompletedProcess[str]) -> str:
    """The only line on standard error."""
    assert answer.stdout == ""
    (line,) = answer.stderr.splitlines()
    assert re.fullmatch(r"dentine: .*[.]", line)
    return line


@pytest.fixture
def job_file(tmp_path: Path) -> Path:
    path = tmp_path / "job.toml"
    path.write_text('capture = "/"\n')
    return path


def test_a_slab_that_cannot_be_read_is_told_before_anything_is_started(tmp_path: Path) -> None:
    told = description(cell={"width_mm": 1.0, "indexx": 1.33})
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "slab.json").write_text(json.dumps(told))
    (tmp_path / "job.toml").write_text('kind = "slab"\ncapture = "cell"\n')
    answer = dentine("run", str(tmp_path / "job.toml"), "--out", str(tmp_path / "out"))
    assert answer.returncode != 0
    assert "unknown key 'cell.indexx'; known keys are boundary, glass, index" in sentence(answer)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('capture = "x"\nsead = 1', "unknown option 'sead'"),
        ('capture = "x"\nior = "thick"', "option 'ior'"),
        ("capture = x", "not valid TOML"),
        ("", "give exactly one of 'capture'"),
        ('[rig]\nmouth = "x"\nlevel = 2', "option 'rig.level'"),
    ],
)
def test_a_bad_job_file_is_named(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "job.toml"
    path.write_text(text)
    answer = dentine("run", str(path), "--out", str(tmp_path / "out"))
    assert answer.returncode == 2
    assert named in sentence(answer)
    assert not (tmp_path / "out").exists()


def test_a_missing_capture_is_named(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.write_text('capture = "nowhere"')
    answer = dentine("run", str(path), "--out", str(tmp_path / "out"), "--workers", "1")
    assert answer.returncode == 2
    assert answer.stderr.splitlines()[-1].startswith("dentine: ")
    assert "nowhere" in answer.stderr.splitlines()[-1]
    assert "Traceback" not in answer.stderr


def test_unknown_options_and_commands_exit_2() -> None:
    assert dentine("run", "--frobnicate").returncode == 2
    assert dentine("frobnicate").returncode == 2
    assert dentine("simulate", "slab", "--boundary", "rough").returncode == 2


def test_version_and_help_need_nothing() -> None:
    for command in ([sys.executable, "-m", "services"], [str(Path(sys.executable).with_name("dentine"))]):
        told = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
        assert re.fullmatch(r"\d+\.\d+\.\d+\n", told)
    assert "simulate" in dentine("--help").stdout


def test_a_process_tells_an_error_as_the_command_line_here_does() -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "services", "run", "--frobnicate"], capture_output=True, text=True, check=False
    )
    here = dentine("run", "--frobnicate")
    assert (answer.returncode, answer.stdout) == (here.returncode, here.stdout) == (2, "")
    assert answer.stderr.splitlines()[-1] == here.stderr.splitlines()[-1]


def test_benchmarks_are_listed_and_an_unknown_one_is_named() -> None:
    names = dentine("bench").stdout.split()
    assert names
    assert f"known are {', '.join(names)} and all" in sentence(dentine("bench", "speed"))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--alpha", "0.9", "--sigma", "2"], "--width"),
        (["--layers", "["], "--layers is not JSON"),
        (["--layers", '[{"sigma": 2, "alpha": 0.9}]'], "thickness_mm"),
        (["--layers", '[{"sigma": 2, "alpha": 0.9, "thickness_mm": 1, "colour": 1}]'], "colour"),
        (["--layers", "[]", "--sigma", "2"], "leave out --sigma"),
        (
            [
                "--layers",
                '[{"sigma": 2, "alpha": 0.9, "thickness_mm": 1, "table": {"angles_rad": [0, 1], "values": [1, 2]}}]',
            ],
            "must increase from 0 to pi",
        ),
        (
            ["--alpha", "0.9", "--sigma", "2", "--width", "1", "--exit-cosines", "0.1;1"],
            "--exit-cosines = 0.1;1 is not a list",
        ),
        (["--alpha", "0.9", "--sigma", "2", "--width", "1", "--ring-edges", "2,1"], "ring-edges = 2, 1"),
    ],
)
def test_a_wrong_slab_is_named(arguments: list[str], named: str) -> None:
    answer = dentine("simulate", "slab", *arguments)
    assert answer.returncode == 2
    assert named in sentence(answer)


def test_a_wrong_setting_names_its_variable(job_file: Path) -> None:
    answer = dentine("submit", str(job_file), DENTINE__SERVER__PORT="many")
    assert answer.returncode == 2
    assert "DENTINE__SERVER__PORT" in sentence(answer)


def test_no_server_is_a_sentence(job_file: Path) -> None:
    answer = dentine("submit", str(job_file), "--server", "http://127.0.0.1:9")
    assert answer.returncode == 4
    assert "http://127.0.0.1:9 does not answer" in sentence(answer)


def test_submit_watch_and_retry_through_a_server(tmp_path: Path, job_file: Path) -> None:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), run_here)) as client:
        server = str(client.base_url)
        job = json.loads(dentine("submit", str(job_file), "--server", server, "--key", "once", "--json").stdout)["id"]
        assert dentine("submit", str(job_file), "--server", server, "--key", "once").stdout == f"{job}\n"
        watched = dentine("watch", job, "--server", server, "--json")
        assert watched.returncode == 0
        assert json.loads(watched.stdout)["state"] == "SUCCEEDED"
        assert "fit 100 %: Step 9; held-out error 1.0 ± 0.2 %." in watched.stderr
        assert dentine("cancel", job, "--server", server).returncode == 2
        assert "There is no job none" in sentence(dentine("watch", "none", "--server", server))


def test_ctrl_c_during_a_capture_leaves_the_dome_dark(tmp_path: Path) -> None:
    """The whole process group gets the signal, as from a terminal."""
    code = (
        "import sys; from pathlib import Path; from services.cli.run import cancelling_on_signals;from"
        " services.pipeline.stages import run_job; from services.core.errors import JobCancelledError;from"
        " services.core.records import JobSpec, RigSpec; from tests.support.toy_stages import DOORS\nif __name__ =="
        " '__main__':\n    root = Path(sys.argv[1])\n    with cancelling_on_signals(root):\n        try:"
        " run_job(JobSpec(rig=RigSpec(mouth=Path('/')), workers=1), root, lambda event: print(event.kind, flush=True),"
        " doors=DOORS)\n        except JobCancelledError as problem: sys.exit(problem.exit_status)\n"
    )
    script = tmp_path / "interrupted.py"
    script.write_text(code)
    (tmp_path / "hold-capture").touch()
    command = [sys.executable, str(script), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "started\n"
        while not (tmp_path / "lit").exists():
            assert process.poll() is None
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60) == 130
    assert not (tmp_path / "lit").exists()
