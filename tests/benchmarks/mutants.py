"""Faults that are put into the services one at a time, and whether a test notices each of them.

    python -m tests.benchmarks.mutants --json mutants.json [--only NAME ...] [--tree FOLDER] [--whole NAME ...]

``mutants.json`` beside this file lists the faults. Each is put into a copy of the tree's last commit, where the test
files whose imports reach the changed module run in one process until the first test fails, those nearest to the module
first; ``--whole`` runs all tests that are not slow. A fault is caught where a test fails or cannot be collected, and
not decided where the time limit ends the run. The file of results is written after each fault, and a later run
continues it. ``--check`` applies every fault and counts the test files that reach it, but runs no test. It takes a
minute or more per fault; a fault that escapes takes as long as all the tests that reach it.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import psutil

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_suffix(".json")
NOT_RUN = ("containers", "load", "benchmarks")
"""Folders of the tests in which no test of a fault lies."""
LIMIT_S = 1500.0
TAIL_LINES = 12
"""Number of lines of a run's end that are kept."""
STATIC, NODE_MODULES = "services/api/dashboard/static", "services/api/dashboard/node_modules"
PLUGIN = """
import pytest


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    # Files that are compiled anew take processor time that no test is to blame for.
    for plugin in list(config.pluginmanager.get_plugins()):
        if type(plugin).__name__ == "ProcessorTimes":
            config.pluginmanager.unregister(plugin)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    places = {str(config.rootpath / name): number for number, name in enumerate(config.args)}
    items.sort(key=lambda item: places.get(str(item.path), len(places)))
"""
"""Plugin of a run: files keep the order of the command line, and no test fails by its processor time."""


@dataclass(frozen=True)
class Mutant:
    """A fault: the file's text ``old``, which occurs once, is replaced by ``new``."""

    name: str
    what: str
    path: str
    old: str
    new: str

    @property
    def module(self) -> str:
        """Dotted name of the changed module."""
        return self.path.removesuffix(".py").replace("/", ".")

    def apply(self, tree: Path) -> None:
        """Change the file below ``tree``.

        Raises:
            SystemExit: the old text does not occur exactly once, or the changed file is no Python.
        """
        path = tree / self.path
        text = path.read_text() if path.is_file() else ""
        if (count := text.count(self.old)) != 1:
            raise SystemExit(f"Mutant {self.name}: its text occurs {count} times in {self.path}; correct the list.")
        changed = text.replace(self.old, self.new)
        try:
            compile(changed, self.path, "exec")
        except SyntaxError as problem:
            raise SystemExit(f"Mutant {self.name}: the changed file is no Python ({problem}); correct it.") from problem
        path.write_text(changed)


@dataclass(frozen=True)
class Outcome:
    """What the tests said of one fault."""

    module: str
    what: str
    test_files: int
    """Number of test files whose imports reach the module."""
    whole: bool
    outcome: Literal["caught", "escaped", "not decided"]
    caught: bool | None
    """None where it was not decided."""
    first_failed: str | None
    """Id of the first test that failed, or of the file that could not be collected."""
    seconds: float
    exit_code: int | None
    """Exit code of pytest; None where the time limit ended it."""
    tail: tuple[str, ...]


@contextmanager
def copied(tree: Path) -> Iterator[Path]:
    """A copy of the tree's last commit with its environment and built page, in a folder that is removed afterwards."""
    archive = subprocess.run(["git", "-C", str(tree), "archive", "HEAD"], check=True, capture_output=True).stdout
    with tempfile.TemporaryDirectory(prefix="mutant-", ignore_cleanup_errors=True) as parent:
        copy = Path(parent) / "tree"
        with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
            packed.extractall(copy, filter="data")
        for source, link in (
            (tree.parent / "shared", copy.parent / "shared"),
            (tree / ".venv", copy / ".venv"),
            (tree / NODE_MODULES, copy / NODE_MODULES),
        ):
            if source.exists():
                link.symlink_to(source.resolve())
        # The server hands out no file that a link leads to, so that these are copied.
        shutil.copytree(tree / STATIC, copy / STATIC, dirs_exist_ok=True)
        (copy / "mutant_plugin.py").write_text(PLUGIN)
        yield copy


def environment(copy: Path) -> dict[str, str]:
    """Variables with which every process below this one imports the copy, and uses one thread."""
    fixed = {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "", "OMP_NUM_THREADS": "1"}
    return os.environ | fixed | {"OPENBLAS_NUM_THREADS": "1"}


def reaching(modules: Sequence[str]) -> dict[str, list[str]]:
    """Test files whose imports reach each module; run in a copy, whose packages are imported.

    The nearest are first, and of those equally near the unit tests, which take the least time. A test file counts as
    importing the ``conftest`` of its own folders, but not the one of all tests.
    """
    import grimp

    graph = grimp.build_graph("services", "tests", "dentine", cache_dir=None)
    names = [name for name in graph.modules if name.rpartition(".")[2].startswith("test_")]
    for name in names:
        folder = name.rpartition(".")[0]
        while "." in folder:
            if f"{folder}.conftest" in graph.modules:
                graph.add_import(importer=name, imported=f"{folder}.conftest")
            folder = folder.rpartition(".")[0]
    found = {}
    for module in modules:
        downstream = graph.find_downstream_modules(module)
        paths = []
        for name in names:
            if name in downstream and name.split(".")[1] not in NOT_RUN:
                chain = graph.find_shortest_chain(importer=name, imported=module) or ()
                paths.append((len(chain), not name.startswith("tests.unit."), f"{name.replace('.', '/')}.py"))
        found[module] = [path for *_, path in sorted(paths)]
    return found


def reaching_in(copy: Path, modules: Sequence[str]) -> dict[str, list[str]]:
    """``reaching`` in a process that imports the copy."""
    command = [sys.executable, "-P", __file__, "--reaching", *modules]
    answer = subprocess.run(command, cwd=copy, env=environment(copy), check=True, capture_output=True, text=True)
    found: dict[str, list[str]] = json.loads(answer.stdout)
    return found


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a process and all that it started."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        family = []
    process.kill()
    for child in family:
        try:
            child.kill()
        except psutil.NoSuchProcess:
            continue
    process.wait()


def run_tests(copy: Path, files: Sequence[str], limit_s: float) -> tuple[int | None, list[str]]:
    """Run tests until the first fails; returns the exit code, None past the time limit, and the lines of output."""
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "mutant_plugin", "-m", "not slow"]
    options += [f"--ignore=tests/{folder}" for folder in NOT_RUN]
    command = [str(copy / ".venv/bin/python"), "-m", "pytest", *options, *files]
    log = copy.parent / "log"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command, cwd=copy, env=environment(copy), stdout=stream, stderr=stream, start_new_session=True
        )
        try:
            code: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            stop(process)
    return code, log.read_text(errors="replace").splitlines()


def judged(mutant: Mutant, files: Sequence[str], *, whole: bool, tree: Path, limit_s: float) -> Outcome:
    """Put a fault into a copy of the tree and run the tests on it."""
    with copied(tree) as copy:
        mutant.apply(copy)
        start = time.monotonic()
        code, lines = run_tests(copy, ("tests",) if whole else files, limit_s) if files or whole else (0, [])
        seconds = time.monotonic() - start
    failed = [match for line in lines if (match := re.match(r"(?:FAILED|ERROR) (tests/.*?)(?: - .*)?$", line))]
    is_caught = code == 1 or (code == 2 and any("ERROR collecting" in line for line in lines))
    outcome: Literal["caught", "escaped", "not decided"] = (
        "caught" if is_caught else "escaped" if code == 0 else "not decided"
    )
    return Outcome(
        mutant.module,
        mutant.what,
        len(files),
        whole,
        outcome,
        None if outcome == "not decided" else is_caught,
        failed[0][1] if failed and is_caught else None,
        round(seconds, 1),
        code,
        tuple(lines[-TAIL_LINES:]),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge the mutants that have no result yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", type=Path, help="file of results, which is continued")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="judge these, also anew")
    parser.add_argument("--whole", nargs="+", metavar="NAME", default=[], help="judge these by all tests, also anew")
    parser.add_argument(
        "--tree", type=Path, default=ROOT, help="checkout whose last commit is tested; default this one"
    )
    parser.add_argument("--limit-s", type=float, default=LIMIT_S, help="longest time of one run, s")
    parser.add_argument("--check", action="store_true", help="run no test")
    parser.add_argument("--reaching", nargs="+", metavar="MODULE", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.reaching:
        print(json.dumps(reaching(given.reaching)))
        return
    if given.json is None and not given.check:
        parser.error("--json is missing; name the file of results.")
    mutants = {one["name"]: Mutant(**one) for one in json.loads(LIST.read_text())}
    named = (*given.only, *given.whole)
    if unknown := [name for name in named if name not in mutants]:
        parser.error(f"There is no mutant {unknown[0]}; the list has {', '.join(mutants)}.")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so that folders are removed then too

    tree = given.tree.resolve()
    with copied(tree) as copy:
        for mutant in mutants.values():
            mutant.apply(copy)
        files = reaching_in(copy, sorted({mutant.module for mutant in mutants.values()}))
    if given.check:
        for name, mutant in mutants.items():
            nearest = ", ".join(files[mutant.module][:2])
            print(f"{name:28} {len(files[mutant.module]):4} test files, first {nearest}")
        return

    commit = subprocess.run(["git", "-C", str(tree), "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    results: dict[str, Any] = {"commit": commit.stdout.strip(), "mutants": {}}
    if given.json.is_file():
        earlier = json.loads(given.json.read_text())
        if earlier["commit"] != results["commit"]:
            parser.error(f"{given.json} has results of commit {earlier['commit']}; name another file.")
        results = earlier
    for name in named or [name for name in mutants if name not in results["mutants"]]:
        mutant, whole = mutants[name], name in given.whole
        found = judged(mutant, files[mutant.module], whole=whole, tree=tree, limit_s=given.limit_s)
        results["mutants"][name] = asdict(found)
        given.json.write_text(json.dumps(results, indent=1) + "\n")
        print(f"{name:28} {found.outcome:12} {found.seconds:7.1f} s  {found.first_failed or ''}", flush=True)


if __name__ == "__main__":
    main()
