"""Names that become parts of file names."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from services.core.geometry import MAX_NAME_BYTES, Light


def light(name: str) -> Light:
    return Light(name=name, position_mm=(0, 0, 0), intensity=(1.0,))


@pytest.mark.parametrize(
    "name",
    ["c0", "l-12", "front left", "...", ".5", "Größe 1.2", "左前", "ضوء", "می‌خواهم", "a:b", "x" * MAX_NAME_BYTES],
)
def test_names_of_any_script_are_accepted(name: str) -> None:
    assert light(name).name == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "/",
        "/tmp/evil/c0",
        "a/b",
        "..\\c0",
        "a\0",
        "a\nb",
        "\x7f",
        "\x9b",
        "\u2028",
        "\ud800",
        "x" * (MAX_NAME_BYTES + 1),
        "左" * 22,
    ],
)
def test_names_that_would_leave_a_folder_or_break_a_line_are_refused(name: str) -> None:
    with pytest.raises(ValidationError, match=r"1 to 64 bytes|surrogates|unicode"):
        light(name)
