"""What can be read in two ways, or stands in for a number, is refused in bodies, TOML and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from services.api.dome.dome import LightRequest
from services.api.http.bodies import parse
from services.core.errors import CaptureInputError, SettingsError
from services.core.files.scans import read_sidecar
from services.core.files.validation import parse_record
from services.core.geometry import Camera, Record
from services.core.raw.folder import parse_raw_folder
from services.core.records import FolderCapture
from services.core.settings import read_job, read_settings

LIGHT = '{"name": "l0", "position_mm": [0, 0, 9], "intensity": [1, 1, 1]}'


def capture(light: str) -> bytes:
    return f'{{"units": "mm", "channels": ["red"], "cameras": [], "lights": [{light}]}}'.encode()


def test_of_two_equal_keys_none_wins() -> None:
    with pytest.raises(SettingsError, match="key 'level' is given twice in one object; give it once"):
        parse(b'{"light": 3, "level": 0.01, "on_s": 2, "level": 1}')
    with pytest.raises(SettingsError, match="key 'a' is given twice"):
        parse(b'{"rig": {"a": 1, "a": 1}}')
    assert parse(b'{"a": {"a": 1}, "b": {"a": 1}}') == {"a": {"a": 1}, "b": {"a": 1}}


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity"])
def test_a_body_holds_no_nan(constant: str) -> None:
    with pytest.raises(SettingsError, match=f"{constant} is no number of JSON"):
        parse(f'{{"on_s": [{constant}]}}'.encode())


@pytest.mark.parametrize(
    ("light", "named"),
    [
        (LIGHT.replace('"name"', '"name": "l1", "name"'), "key 'name' is given twice"),
        (LIGHT.replace("[0, 0, 9]", "[0, NaN, 9]"), "NaN is no number"),
        (LIGHT.replace("[0, 0, 9]", '[0, "0", 9]'), "lights.0.position_mm.1: give a number"),
        (LIGHT.replace("[0, 0, 9]", "[0, true, 9]"), "lights.0.position_mm.1: give a number"),
    ],
)
def test_a_file_is_read_in_one_way_or_not_at_all(light: str, named: str) -> None:
    assert parse_record(capture(LIGHT), FolderCapture, "capture.json").lights[0].position_mm == (0, 0, 9)
    with pytest.raises(CaptureInputError, match=r"^capture\.json: .*" + named):
        parse_record(capture(light), FolderCapture, "capture.json")


@pytest.mark.parametrize("stand_in", [True, False, "1", "5"])
def test_no_record_takes_a_text_or_a_truth_for_a_number(stand_in: Any) -> None:
    class Measured(Record):
        count: int = 0
        size: float | None = None
        row: tuple[float, ...] = ()
        table: dict[str, float] | None = None
        by_tooth: dict[int, float] | None = None

    for wrong in ({"count": stand_in}, {"size": stand_in}, {"row": [stand_in]}, {"table": {"a": stand_in}}):
        for check in (Measured.model_validate, TypeAdapter(Measured).validate_python):
            with pytest.raises(ValidationError, match="give a number, neither a text nor true or false"):
                check(wrong)
    # The keys of a table in JSON are texts.
    assert Measured.model_validate_json('{"by_tooth": {"11": 2}, "count": 2.0}').by_tooth == {11: 2.0}
    with pytest.raises(ValidationError, match="give a number"):
        LightRequest.model_validate({"light": 0, "on_s": stand_in})
    with pytest.raises(ValidationError, match="give a number"):
        Camera.model_validate({"size": [stand_in, 4], "name": "a"})


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("seed = 1\nseed = 2", "TOML"),
        ("ior = nan", "ior"),
        ("image_tolerance = inf", "image_tolerance"),
        ('seed = "5"', "seed"),
        ("ior = true", "ior"),
        ("held = {'enamel.sigma' = true}", "held"),
        ("held = {'enamel.sigma' = '4.5'}", "held"),
        ("held = {'enamel.sigma' = nan}", "held"),
        ("rig = {mouth = 'm', level = '1'}", "rig.level"),
    ],
)
def test_a_job_file_is_read_in_one_way_or_not_at_all(tmp_path: Path, line: str, named: str) -> None:
    (tmp_path / "job.toml").write_text(f"capture = 'x'\n{line}\n" if "rig" not in line else line)
    with pytest.raises(SettingsError, match=named):
        read_job(tmp_path / "job.toml")


@pytest.mark.parametrize("wrong", ["size = [40, true]\nbits = 12", "size = [40, 30]\nbits = '12'"])
def test_a_raw_folder_is_read_in_one_way_or_not_at_all(wrong: str) -> None:
    text = f"units = 'mm'\n[[camera]]\nname = 'c0'\nmosaic = 'none'\nchannels = ['red']\n{wrong}\n"
    with pytest.raises(CaptureInputError, match="number"):
        parse_raw_folder(text.encode(), "raw.toml")


@pytest.mark.parametrize("text", ['{"labels": [1, "2"]}', '{"labels": [true]}', '{"labels": [1], "labels": [2]}'])
def test_labels_of_a_scan_are_numbers(tmp_path: Path, text: str) -> None:
    (tmp_path / "labels.json").write_text(text)
    with pytest.raises(CaptureInputError, match=r"labels\.json cannot be read"):
        read_sidecar(tmp_path / "labels.json")


def test_variables_of_an_environment_stay_texts() -> None:
    assert read_settings({"DENTINE__SERVER__PORT": "81"}).server.port == 81
