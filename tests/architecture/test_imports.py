"""The light packages load no heavy ones, and one room alone reads the environment. import-linter keeps the rest."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = ("mitsuba", "drjit", "cv2", "pymodbus", "scipy", "trimesh", "PIL")
SERVICES = ("services.calibrate", "services.capture", "services.preprocess", "services.fit")


def modules_after(code: str) -> set[str]:
    """Names of all modules that a fresh interpreter has loaded after running some code."""
    script = f"{code}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    return set(json.loads(answer.stdout.splitlines()[-1]))


def modules_below(room: str) -> list[str]:
    folder = ROOT / "services" / room
    paths = (
        path.relative_to(folder).with_suffix("") for path in sorted(folder.rglob("*.py")) if path.stem != "__init__"
    )
    # Migration steps are files that Alembic reads, not modules.
    return [".".join(("services", room, *path.parts)) for path in paths if path.parts[0] != "migrations"]


@pytest.mark.parametrize("room", ["core", "api"])
def test_light_rooms_load_nothing_heavy(room: str) -> None:
    loaded = modules_after("import " + ", ".join(modules_below(room)))
    assert not [name for name in loaded if name.startswith(SERVICES) or name.split(".")[0] in HEAVY]


def test_an_application_starts_without_the_stages(tmp_path: Path) -> None:
    loaded = modules_after(
        "from pathlib import Path\nfrom services.api.app import create_app\nfrom services.core.settings import"
        f" ServerSettings\ncreate_app(ServerSettings(data=Path({str(tmp_path)!r})))"
    )
    assert not [name for name in loaded if name.startswith(SERVICES) or name.split(".")[0] in HEAVY]


def test_the_command_line_starts_light() -> None:
    loaded = modules_after("from services.cli.app import build_app\nbuild_app()")
    assert not [
        name
        for name in loaded
        if name.startswith(SERVICES) or name.split(".")[0] in (*HEAVY, "fastapi", "distributed", "zarr", "sqlalchemy")
    ]


def test_only_the_composition_root_reads_the_environment() -> None:
    reading = re.compile(r"environ\[|environ\.get|getenv|read_settings\(os")
    readers = [path for path in (ROOT / "services").rglob("*.py") if reading.search(path.read_text())]
    assert {path.relative_to(ROOT / "services").parts[0] for path in readers} == {"cli"}


def test_files_stay_small() -> None:
    lines = {path: len(path.read_text().splitlines()) for path in (ROOT / "services").rglob("*.py")}
    assert not {path.name: count for path, count in lines.items() if count > 500}
    assert sorted(lines.values())[len(lines) // 2] < 200


def test_every_error_survives_pickling() -> None:
    import pickle

    from services.core.errors import DentineError

    def below(kind: type[DentineError]) -> list[type[DentineError]]:
        return [kind, *(found for child in kind.__subclasses__() for found in below(child))]

    codes = set()
    for kind in below(DentineError):
        copy = pickle.loads(pickle.dumps(kind("The lamp is out; replace it.")))
        assert (type(copy), copy.message) == (kind, "The lamp is out; replace it.")
        codes.add(kind.code)
    assert len(codes) == len(below(DentineError))
