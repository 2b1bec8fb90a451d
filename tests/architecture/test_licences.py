"""The program may be redistributed: every dependency, of the Python code and of the dashboard, names a licence that
allows it.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
LOCK_OF_THE_PAGE = ROOT / "services" / "api" / "dashboard" / "package-lock.json"
_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = tuple(sorted(_PROJECT["optional-dependencies"].keys() - {"dev"}))
"""Every extra that users install; the tools of developers are not given on."""
PERMISSIVE = re.compile(
    r"\b(MIT(-0|-CMU)?|0?BSD(-[23]-Clause)?|ISCL?|Apache(-2\.0)?|PSF(-2\.0)?|Python Software Foundation"
    r"|Zlib|CC0-1\.0|Unlicense|HPND|MPL(-2\.0)?|Mozilla)\b"
)
"""Pattern of licences that allow redistribution. The Mozilla licence is among them, as it binds changes to its own
files alone."""
BSD_3_CLAUSES = (
    "Redistribution and use in source and binary forms, with or without modification, are permitted",
    "Neither the name of the copyright holder nor the names of its contributors may be used to endorse",
)
LINKED = {"psycopg": "LGPL-3.0-only", "psycopg-binary": "LGPL-3.0-only"}
"""Packages with a weak copyleft licence: it allows their use as unchanged libraries that users can replace, as they can
an installed Python package."""
STRONG = re.compile(r"\bA?GPL|GNU (Affero )?General Public")


def licence(of: Distribution) -> str:
    """Licence that the package's metadata state."""
    told = of.metadata
    classified = [one.rpartition(" :: ")[2] for one in told.get_all("Classifier", []) if one.startswith("License ::")]
    expression, plain = (next(iter(told.get_all(name, [])), "") for name in ("License-Expression", "License"))
    return str(expression or "; ".join(classified) or plain.partition("\n")[0] or _of_its_text(of))


def _of_its_text(of: Distribution) -> str:
    """Name of a licence whose text a package brings without naming it; empty where the text is of another one."""
    texts = [" ".join(file.read_text().split()) for file in of.files or () if "licenses/" in str(file)]
    return "BSD-3-Clause" if len(texts) == 1 and all(clause in texts[0] for clause in BSD_3_CLAUSES) else ""


def dependencies(name: str, extras: tuple[str, ...], seen: set[str]) -> Iterator[Distribution]:
    """Yield all direct and indirect dependencies of a package with extras, as installed here."""
    for text in distribution(name).requires or ():
        wanted = Requirement(text)
        applies = wanted.marker is None or any(wanted.marker.evaluate({"extra": extra}) for extra in ("", *extras))
        key = wanted.name.lower().replace("_", "-") + "".join(sorted(wanted.extras))
        if not applies or key in seen:
            continue
        seen.add(key)
        try:
            found = distribution(wanted.name)
        except PackageNotFoundError:  # a dependency of another platform
            continue
        if wanted.name != "dentine":
            yield found
        yield from dependencies(wanted.name, tuple(wanted.extras), seen)


def test_every_python_package_may_be_given_on() -> None:
    found = {one.name.lower().replace("_", "-"): licence(one) for one in dependencies("dentine", EXTRAS, set())}
    assert {"mitsuba", "psycopg", "numpy", "fastapi", "rawpy", "obstore"} <= found.keys()
    for name, text in found.items():
        assert text, f"{name} names no licence"
        allowed = LINKED[name] == text if name in LINKED else bool(PERMISSIVE.search(text)) and not STRONG.search(text)
        assert allowed, f"{name}: {text}"


def test_every_package_of_the_page_may_be_given_on() -> None:
    packages = json.loads(LOCK_OF_THE_PAGE.read_text())["packages"]
    assert len(packages) > 2
    for path, package in packages.items():
        if path:
            assert PERMISSIVE.search(package["license"]), (path, package["license"])


@pytest.mark.parametrize(
    "text",
    [
        "GPL-3.0-only",
        "GNU General Public License v3 (GPLv3)",
        "AGPL-3.0",
        "GNU Affero General Public License v3",
        "Commercial",
    ],
)
def test_a_licence_that_binds_the_whole_is_found(text: str) -> None:
    assert STRONG.search(text) or not PERMISSIVE.search(text)
