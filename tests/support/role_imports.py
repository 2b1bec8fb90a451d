"""Execute every import that a role's code can reach, in a process that has only the packages of the role.

``python -m tests.support.role_imports ROLE`` prints as JSON each import that failed and the module that makes it.
"""

from __future__ import annotations

import ast
import importlib
import importlib.abc
import importlib.metadata
import importlib.util
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from tests.support.roles import ROLES, distributions, normal

REGISTRY = "services.cli.app:build_app"
"""Function that registers every command and calls none. Its imports are executed but not followed, because a command's
own imports belong to the roles that run it."""


class Refusal(importlib.abc.MetaPathFinder):
    """Import finder that refuses the packages that are installed here but not where the role runs."""

    def __init__(self, extras: Iterable[str]) -> None:
        allowed = distributions(extras)
        providers = importlib.metadata.packages_distributions()
        self._refused = {
            package for package, names in providers.items() if not {normal(name) for name in names} & allowed
        }
        self._refused -= {"services", "tests", *sys.stdlib_module_names}

    def find_spec(
        self, fullname: str, _path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Raise for a refused package, and leave the others to the other finders."""
        if fullname.partition(".")[0] in self._refused:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)
        return None


def reach(entries: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield (module of this project, imported name) for every import at any place except those for type checking. The
    project's own modules are followed.
    """
    todo, seen = list(entries), set[str]()
    while todo:
        entry = todo.pop()
        module, _, function = entry.partition(":")
        if entry in seen or module in seen:
            continue
        seen.add(entry)
        tree = ast.parse(_source(module).read_text())
        body: Iterable[ast.stmt] = _of_function(tree, function, alone=entry == REGISTRY) if function else tree.body
        for name in _imported(body):
            yield module, name
            if name.partition(".")[0] == "services" and entry != REGISTRY:
                todo.append(name)


def _source(module: str) -> Path:
    spec = importlib.util.find_spec(module)
    assert spec is not None, module
    assert spec.origin is not None, module
    return Path(spec.origin)


def _of_function(tree: ast.Module, function: str, *, alone: bool) -> Iterator[ast.stmt]:
    """Yield the module's statements outside functions and classes, the function and, unless ``alone``, the functions of
    the module that it names, directly or through others.
    """
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    yield from (node for node in tree.body if not isinstance(node, ast.FunctionDef | ast.ClassDef))
    named, todo = set[str](), [function]
    while todo:
        name = todo.pop()
        named.add(name)
        yield functions[name]
        inside = {node.id for node in ast.walk(functions[name]) if isinstance(node, ast.Name)}
        todo += [] if alone else sorted((inside & functions.keys()) - named)


def _imported(body: Iterable[ast.stmt]) -> Iterator[str]:
    for statement in body:
        yield from _Imports.of(statement)


class _Imports(ast.NodeVisitor):
    def __init__(self) -> None:
        self.names: list[str] = []

    @classmethod
    def of(cls, node: ast.AST) -> list[str]:
        visitor = cls()
        visitor.visit(node)
        return visitor.names

    def visit_If(self, node: ast.If) -> None:
        if not (isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
            self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> None:
        self.names += [alias.name for alias in node.names]

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        assert node.level == 0, "this project imports by whole names"
        assert node.module is not None
        self.names.append(node.module)
        if node.module.partition(".")[0] == "services":
            self.names += [inside for alias in node.names if _is_module(inside := f"{node.module}.{alias.name}")]

    def visit_Call(self, node: ast.Call) -> None:
        match node:
            case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str() as name)]):
                self.names.append(name)
        self.generic_visit(node)


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def failures(role: str) -> list[str]:
    """One sentence for each package that the role's code imports but the role does not install."""
    chosen = ROLES[role]
    imports = dict.fromkeys(reach(chosen.entries))
    sys.meta_path.insert(0, Refusal(chosen.extras))
    failed: dict[str, str] = {}
    for module, name in imports:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as problem:
            failed.setdefault(str(problem.name), f"{module} imports {name}: {problem}")
    return list(failed.values())


if __name__ == "__main__":
    print(json.dumps(failures(sys.argv[1])))
