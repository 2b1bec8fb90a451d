"""``dentine options`` prints all options of a job file, in the form of such a file."""

from __future__ import annotations

import tomllib

import pytest
from typer.testing import CliRunner

from services.api.presets import Preset, list_presets
from services.cli.app import build_app
from services.core.records import JobSpec


def printed(*arguments: str) -> str:
    found = CliRunner().invoke(build_app(), ["options", *arguments])
    assert found.exit_code == 0, found.output
    return found.output


def test_every_option_is_listed_with_its_default_and_meaning() -> None:
    text = printed()
    own = text.partition("\n[rig]")[0]
    defaults = tomllib.loads(own)
    for name, field in JobSpec.model_fields.items():
        line = next(line for line in own.splitlines() if line.removeprefix("# ").startswith(f"{name} = "))
        assert str(field.description) in line
        assert name not in defaults or defaults[name] == field.default or list(field.default) == defaults[name]
    assert "tracking_every = 6" in text
    assert "one of matched, thin" in own


@pytest.mark.parametrize("preset", list_presets(), ids=lambda one: one.name)
def test_a_preset_is_printed_as_a_job_reads_it(preset: Preset) -> None:
    assert tomllib.loads(printed("--preset", preset.name)) == preset.options


def test_an_unknown_preset_is_told_with_those_there_are() -> None:
    found = CliRunner().invoke(build_app(), ["options", "--preset", "fast"])
    assert "There is no preset 'fast'; there are accurate, demo, jaw" in str(found.exception)
