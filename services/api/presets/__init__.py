"""Named sets of a job's options that are shipped with the package, one TOML file each."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from pydantic import Field

from services.client.errors import UnknownPresetError
from services.core.geometry import Record


class Preset(Record):
    """Options to merge into a job's own."""

    name: str
    summary: str = Field(description="what it is for, in a sentence or two")
    options: dict[str, Any] = Field(description="as in POST /v1/jobs; what is left out keeps its default")


@cache
def list_presets() -> list[Preset]:
    """Return all presets, sorted by name. They are read once, as they belong to the package."""
    files = (file for file in resources.files(__name__).iterdir() if file.name.endswith(".toml"))
    return sorted(
        (Preset(name=file.name.removesuffix(".toml"), **tomllib.loads(file.read_text())) for file in files),
        key=lambda preset: preset.name,
    )


def find_preset(name: str) -> Preset:
    """Return the preset of a name.

    Raises:
        UnknownPresetError: there is no preset of this name.
    """
    presets = {preset.name: preset for preset in list_presets()}
    if name not in presets:
        raise UnknownPresetError(f"There is no preset {name!r}; there are {', '.join(presets)}.")
    return presets[name]
