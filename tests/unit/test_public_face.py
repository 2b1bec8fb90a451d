"""``import dentine`` loads little, and each of its names leads to what it promises."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import dentine
from services.core.errors import CorruptStoreError, MissingStageError
from services.core.results import AssetManifest, Estimate
from services.core.store import StageWriter, write_atomic

HEAVY = ("sqlalchemy", "fastapi", "dask", "distributed", "cv2", "mitsuba", "drjit", "zarr", "pymodbus", "scipy")


def test_the_client_brings_neither_database_nor_server_nor_renderer() -> None:
    code = f"import dentine, sys; dentine.Client('http://127.0.0.1:1'); print([n for n in {HEAVY} if n in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name in dentine.__all__ if name != "register_mitsuba"])
def test_every_name_leads_somewhere(name: str) -> None:
    assert callable(getattr(dentine, name))
    assert name in dir(dentine)


def test_another_name_is_told_with_those_that_there_are() -> None:
    with pytest.raises(AttributeError, match=r"'Server'; it has AsyncClient, Client"):
        dentine.Server  # noqa: B018


def job_with_asset(folder: Path) -> Path:
    writer = StageWriter(folder, "asset", 1)
    (writer.folder / "scene_green.xml").write_text("<scene/>")
    writer.publish(AssetManifest(files=("scene_green.xml",), held_out_error=0.02))
    estimate = Estimate(value=4.0, se=0.1, unit="1/mm", determined=True)
    write_atomic(folder / "parameters.json", f'{{"green": {{"enamel.sigma": {estimate.model_dump_json()}}}}}'.encode())
    return folder


def test_an_asset_is_read_with_its_uncertainty(tmp_path: Path) -> None:
    asset = dentine.load_asset(job_with_asset(tmp_path))
    assert asset.manifest.held_out_error == 0.02
    assert asset.parameters["green"]["enamel.sigma"].se == 0.1
    assert asset.scene("green").name == "scene_green.xml"
    with pytest.raises(CorruptStoreError, match="channels green"):
        asset.scene("blue")


def test_a_job_without_asset_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingStageError):
        dentine.load_asset(tmp_path)


@pytest.mark.parametrize("text", ["{", '{"green": 3}', '{"green": {"enamel.sigma": {}}}'])
def test_damaged_parameters_are_told(tmp_path: Path, text: str) -> None:
    job_with_asset(tmp_path)
    (tmp_path / "parameters.json").write_text(text)
    with pytest.raises(CorruptStoreError, match=r"parameters.json cannot be read"):
        dentine.load_asset(tmp_path)
