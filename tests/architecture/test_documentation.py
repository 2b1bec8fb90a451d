"""What the pages name exists: commands and their options, make targets, modules, files and options of jobs; blocks that
are marked as examples run, and the documentation stays short enough to be kept true.

A block is marked by the comment ``<!-- example -->`` on the line before it. Lines of code in that comment run first and
define what the block takes for granted. The rendered page shows none of it.
"""

from __future__ import annotations

import ast
import json
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer

import dentine
from services.cli.app import build_app
from services.cli.bench import _BENCHMARKS
from services.core.light.safety import FlashAcknowledgement
from services.core.raw.folder import parse_raw_folder
from services.core.records import JobSpec
from tests.architecture.test_markdown_links import CODE, FENCE, ROOT, pages

MAX_WORDS = 45_000
"""Most words in docs/; a word is whatever stands between blanks and has a letter or a digit."""
FENCED = re.compile(r"^ {0,3}(```|~~~)(\w*)\n(.*?)^ {0,3}\1", re.MULTILINE | re.DOTALL)
EXAMPLE = re.compile(r"^<!-- example\b\s*(.*?)-->\n```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:^|[\s/])dentine +([a-z][^#`|]*)")
MODULE = re.compile(r"\bpython3? -m ((?:services|tests|dentine)[\w.]*)([^`|]*)")
TARGET = re.compile(r"^(?:\$ )?(?:[A-Z_]+=(?:\"[^\"]*\"|\S*)\s+)*make ([a-z][\w-]*)")
OPTION = re.compile(r"(?<![\w-])(--[a-z][\w-]*)")
FILE = re.compile(r"(?:dentine|services|tests|deploy|docs)/[\w./-]+")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
MADE_BY_USERS = {"deploy/.env", "deploy/monitoring/metrics-token"}

every_page = pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))


def blocks(text: str, *languages: str) -> Iterator[str]:
    return (body for _, language, body in FENCED.findall(text) if language in languages)


def lines_of_code(text: str) -> Iterator[str]:
    """Code between backquotes, and lines of blocks in no language, where a remark follows two blanks or a #."""
    for block in blocks(text, "", "sh", "console"):
        for line in re.sub(r"\\\n\s*", "", block).splitlines():
            yield from (re.split(r" {2,}|\s#\s", part.strip())[0] for part in line.split("&&"))
    yield from (" ".join(found.group().strip("`").split()) for found in CODE.finditer(FENCE.sub("", text)))


@cache
def commands() -> Any:
    return typer.main.get_command(build_app())


def wrong_command(words: list[str]) -> str | None:
    """What is wrong with the arguments of ``dentine``; None where nothing is."""
    command, path = commands(), "dentine"
    while hasattr(command, "commands"):
        if not words or not re.fullmatch(r"[a-z][a-z-]*", words[0]):
            break
        name = words.pop(0)
        if name not in command.commands:
            return f"{path} {name}: there is no such command"
        command, path = command.commands[name], f"{path} {name}"
    if path == "dentine bench" and words and words[0].islower() and words[0] not in {*_BENCHMARKS, "all"}:
        return f"{path} {words[0]}: there is no such benchmark"
    if command.context_settings.get("ignore_unknown_options"):
        return None
    known = {"--help", *(name for option in command.params for name in (*option.opts, *option.secondary_opts))}
    unknown = [option for option in OPTION.findall(" ".join(words)) if option not in known]
    return f"{path}: there is no option {unknown[0]}" if unknown else None


def wrong_commands(text: str) -> list[str]:
    found = (wrong_command(re.sub(r"[\[\]()]", " ", rest).split()) for rest in matches(COMMAND, text))
    return [problem for problem in found if problem]


def matches(pattern: re.Pattern[str], text: str) -> Iterator[str]:
    return (found.group(1) for line in lines_of_code(text) for found in pattern.finditer(line))


@every_page
def test_commands_and_their_options_exist(page: Path) -> None:
    assert wrong_commands(page.read_text()) == []


@pytest.mark.parametrize(
    ("text", "is_wrong"),
    [
        ("`dentine run JOB.toml --out DIR`", False),
        ("`dentine nothing`", True),
        ("`dentine run JOB.toml --nothing`", True),
        ("```\n.venv/bin/dentine token make NAME     prints it\n```", True),
        ("```\ndentine jobs [--state failed]     lists; --nothing is no option\n```", False),
        ("```\ndentine token create NAME \\\n  --nothing\n```", True),
        ("`dentine bench nothing`", True),
        ("`dentine[capture]` and `import dentine`", False),
    ],
)
def test_a_wrong_command_is_found(text: str, is_wrong: bool) -> None:
    assert bool(wrong_commands(text)) == is_wrong


@every_page
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(matches(TARGET, page.read_text())) <= targets


def source(module: str) -> str | None:
    """Source text of a module or of the program of a package."""
    path = ROOT.joinpath(*module.split("."))
    found = [file for file in (path.with_suffix(".py"), path / "__main__.py") if file.exists()]
    return found[0].read_text() if found else None


def wrong_program(module: str, rest: str) -> str | None:
    """Options are looked for in the module and in what it imports of this project, which may read them for it."""
    text = source(module)
    if text is None:
        return f"python -m {module}: there is no such module"
    imported = {
        name
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module
        for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
        if name.startswith(("services", "tests"))
    }
    read = "\n".join([text, *(source(name) or "" for name in imported)])
    unknown = [option for option in OPTION.findall(rest) if f'"{option}"' not in read]
    return f"python -m {module}: there is no option {unknown[0]}" if unknown else None


@every_page
def test_modules_that_are_run_exist_with_their_options(page: Path) -> None:
    runs = [found.groups() for line in lines_of_code(page.read_text()) for found in MODULE.finditer(line)]
    assert [problem for run in runs if (problem := wrong_program(*run))] == []


def test_a_wrong_module_or_option_is_found() -> None:
    assert wrong_program("tests.benchmarks.nothing", "") is not None
    assert wrong_program("tests.benchmarks.upload_resume", " --nothing") is not None


@every_page
def test_files_that_are_named_exist(page: Path) -> None:
    named = {line for line in lines_of_code(page.read_text()) if FILE.fullmatch(line)}
    assert {name for name in named - MADE_BY_USERS if not (ROOT / name).exists()} == set()


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.stem)
def test_options_of_jobs_exist(page: Path) -> None:
    """Tables whose first column is headed ``option``, or is the kind of a job whose options are in the last one."""
    text, named = FENCE.sub("", page.read_text()), set[str]()
    for table in TABLE.findall(text):
        rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in table.splitlines()]
        if rows[0][0] == "option":
            named |= set(re.findall(r"`([a-z_]+)(?: = [^`]+)?`", " ".join(row[0] for row in rows[2:])))
    assert named <= set(JobSpec.model_fields)


@every_page
def test_descriptions_in_toml_and_json_are_accepted(page: Path) -> None:
    for block in blocks(page.read_text(), "toml"):
        tree = tomllib.loads(block)
        if "capture" in tree:
            JobSpec.model_validate(tree)
        elif flashes := tree.get("rig", {}).get("flashes"):
            FlashAcknowledgement.model_validate(flashes)
        elif "camera" in tree:
            parse_raw_folder(block.encode(), page.name)
    for block in blocks(page.read_text(), "json"):
        json.loads(block if block.lstrip().startswith("{") else f"{{{block}}}")


@every_page
def test_python_uses_the_public_names(page: Path) -> None:
    for block in blocks(page.read_text(), "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                owner = {"dentine": dentine, "client": dentine.Client}.get(node.value.id)
                assert owner is None or hasattr(owner, node.attr)
            elif isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith("services")


@every_page
def test_examples_run(page: Path) -> None:
    for before, language, block in EXAMPLE.findall(page.read_text()):
        assert language == "python"
        exec(compile(f"{before}\n{block}", str(page), "exec"), {})


def test_the_documentation_is_short() -> None:
    words = {
        page: sum(any(sign.isalnum() for sign in word) for word in page.read_text().split())
        for page in (ROOT / "docs").rglob("*.md")
    }
    assert sum(words.values()) <= MAX_WORDS
