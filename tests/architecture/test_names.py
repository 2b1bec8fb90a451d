"""Every name of a module or function in a string exists, modules import each other in one direction, and folders and
files stay small.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import re
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAME = re.compile(r"services(\.\w+)+(:\w+)?")
FORMER_NAMES = {"services.fit.transport.engine:Engine"}
"""Names in checkpoints that are still continued."""
MAX_SIDE_BY_SIDE = 20
MAX_LINES = 400


def sources(*folders: str) -> Iterator[Path]:
    return (
        path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")) if "node_modules" not in path.parts
    )


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def named_in_text() -> list[str]:
    """Names in strings of the code: modules to import, functions to call, and attributes that tests replace."""
    trees = (ast.parse(path.read_text()) for path in sources("services", "tests"))
    texts = (
        node.value
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )
    return sorted({text for text in texts if NAME.fullmatch(text)} - FORMER_NAMES)


@pytest.mark.parametrize("name", named_in_text())
def test_a_name_in_text_leads_somewhere(name: str) -> None:
    parts = re.split(r"[.:]", name)
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError as problem:
            if (problem.name or "").startswith("services"):
                continue
            raise
        for attribute in parts[length:]:
            # A test may replace a built-in function for one module.
            found = getattr(found, attribute) if hasattr(found, attribute) else getattr(builtins, attribute)
        return
    raise AssertionError(f"Nothing is called {name}.")


def test_no_module_reaches_itself_by_its_imports() -> None:
    """Imports inside functions and imports for type checking count too."""
    try:
        TopologicalSorter(imports_of_modules()).prepare()
    except CycleError as circle:
        pytest.fail(" imports ".join(circle.args[1]))


def test_no_two_folders_side_by_side_import_each_other() -> None:
    arrows = {pair for pair in map(folders_side_by_side, *zip(*arrows_of_modules(), strict=True)) if pair is not None}
    assert sorted(pair for pair in arrows if pair[0] < pair[1] and pair[::-1] in arrows) == []


def arrows_of_modules() -> list[tuple[str, str]]:
    return [(module, other) for module, imported in imports_of_modules().items() for other in imported]


def folders_side_by_side(module: str, other: str) -> tuple[str, str] | None:
    """Folders in which two modules are, at the level where their ways part; None where one of them is a file there."""
    ways = module.split("."), other.split(".")
    depth = next((k for k, (a, b) in enumerate(zip(*ways, strict=False)) if a != b), None)
    if depth is None:
        return None
    places = [".".join(way[: depth + 1]) for way in ways]
    both_folders = all((ROOT / place.replace(".", "/")).is_dir() for place in places)
    return (places[0], places[1]) if both_folders else None


@cache
def imports_of_modules() -> dict[str, set[str]]:
    """Modules of ``services`` with the modules that each imports, also inside functions and for type checking."""
    paths = {module_of(path): path for path in sources("services")}
    graph: dict[str, set[str]] = {}
    for module, path in paths.items():
        imported = set[str]()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {name.name for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                below = {f"{node.module}.{name.name}" for name in node.names}
                imported |= below & paths.keys() or {node.module}
        graph[module] = imported & paths.keys()
    return graph


def test_no_folder_is_so_full_that_a_file_cannot_be_found() -> None:
    counts = {
        folder: sum(path.stem != "__init__" for path in folder.glob("*.py"))
        for folder in {path.parent for path in sources("services")}
    }
    assert not {str(folder.relative_to(ROOT)): count for folder, count in counts.items() if count > MAX_SIDE_BY_SIDE}


def test_no_file_is_too_long_to_be_read_at_once() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in sources("services", "tests")}
    assert not {str(path.relative_to(ROOT)): length for path, length in lengths.items() if length > MAX_LINES}


def test_every_name_that_is_imported_is_there() -> None:
    """No other test imports the benchmarks and fault matrices, so only this test finds names that have moved there."""
    defined: dict[str, set[str]] = {}
    asked: list[tuple[Path, str, str]] = []
    for path in sources("services", "tests", "dentine"):
        tree = ast.parse(path.read_text())
        defined[module_of(path)] = names_bound_in(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module is not None:
                asked += [(path, node.module, alias.name) for alias in node.names]
    missing = [
        f"{path.relative_to(ROOT)}: {module}.{name}"
        for path, module, name in asked
        if module in defined and name not in defined[module] and f"{module}.{name}" not in defined
    ]
    assert missing == []


def names_bound_in(tree: ast.Module) -> set[str]:
    """Names that a module defines, assigns or imports; with ``__getattr__``, also the names in its ``__all__``."""
    bound: set[str] = set()
    nodes = list[ast.AST](tree.body)
    while nodes:
        node = nodes.pop()
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                bound.add(name)
                # Names bound inside a function or class are not the module's.
                continue
            case ast.Name(id=name, ctx=ast.Store()):
                bound.add(name)
            case ast.Import() | ast.ImportFrom():
                bound |= {alias.asname or alias.name for alias in node.names}
        nodes += ast.iter_child_nodes(node)
    if "__getattr__" in bound:
        lists = (
            one.value for one in tree.body if isinstance(one, ast.Assign) and ast.unparse(one.targets[0]) == "__all__"
        )
        bound |= {name for listed in lists for name in ast.literal_eval(listed)}
    return bound


def test_a_name_that_is_only_written_or_bound_inside_is_not_there() -> None:
    """Names in ``__all__`` count only if the module has ``__getattr__``."""
    written = "if True:\n    there = 1\ndef made() -> None:\n    inside = 2\n'lost'\n__all__ = ['listed']\n"
    assert names_bound_in(ast.parse(written)) == {"there", "made", "__all__"}
    assert names_bound_in(ast.parse(written + "def __getattr__(name): ...\n")) >= {"listed"}


def test_bounds_are_called_maximum_and_minimum() -> None:
    """All code uses the same words for bounds: those of textbooks."""
    others = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources("services", "tests", "dentine")
        for name in names_bound_in(ast.parse(path.read_text()))
        if re.fullmatch(r"(MOST|LEAST)(_[A-Z0-9_]+)?", name)
    }
    assert others == set()
