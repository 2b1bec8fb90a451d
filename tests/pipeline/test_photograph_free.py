"""What leaves without photographs holds no pixel and no hash of one: searched byte by byte, after a search of the same
kind has found them in what leaves with photographs.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from services.assets.exporters import export_to
from services.assets.photograph_free import export_without_photographs
from services.assets.provenance.departing import BESIDE_PHOTOGRAPH
from services.assets.stage import export
from services.core.errors import ConsentError, SettingsError
from services.core.pages.pictures import png_bytes, read_pictures, tone_map, white_level
from services.core.provenance.hash_list import require_unedited
from services.core.records import JobSpec
from services.core.stage import LocalContext
from services.core.store import write_record
from services.fit.stage import run as fit
from services.preprocess.stage import run as prepare
from tests.pipeline.test_reproduce import OPTIONS
from tests.support.command_line import dentine
from tests.support.folder_captures import write_folder, write_tree
from tests.support.prepared import FAKE

DATA_URI = re.compile(rb"data:image/png;base64,([A-Za-z0-9+/=]+)")
Needles = dict[str, bytes]


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job of two channels with a mask by hand, and a picture beside a photograph in its asset."""
    root = tmp_path_factory.mktemp("job")
    tree = write_folder(root / "capture")
    write_tree(root / "capture", tree | {"consent": {"uses": ["research"], "until": "9999-01-01"}, "subject": "P07"})
    masks = root / "job" / "masks"
    masks.mkdir(parents=True)
    mask = np.zeros((16, 20), dtype=np.uint8)
    mask[:2] = 255
    Image.fromarray(mask).save(masks / "front@all.png")
    spec = JobSpec(capture=root / "capture", **OPTIONS | {"channels": None})
    write_record(root / "job" / "job.json", spec)
    context = LocalContext(root / "job")
    prepare(spec, context)
    fit(spec, context, engine=FAKE)
    with pytest.MonkeyPatch.context() as patch:
        write = "services.assets.asset.write_asset"
        from services.assets.asset import write_asset

        def with_picture(folder: Path, *words: object, **options: object) -> tuple[str, ...]:
            files = write_asset(folder, *words, **options)  # type: ignore[arg-type]
            picture = read_pictures(root / "job" / "fit" / "pictures.npz")[0]
            shown = tone_map(picture.photo, white_level(picture.photo, picture.valid))
            (folder / BESIDE_PHOTOGRAPH).write_bytes(png_bytes(shown))
            return (*files, BESIDE_PHOTOGRAPH)

        patch.setattr(write, with_picture)
        export(spec, context)
    return root / "job"


def hashes(name: str, content: bytes) -> Needles:
    found: Needles = {}
    for kind in ("sha256", "sha1", "md5"):
        digest = hashlib.new(kind, content)
        found |= {f"{kind} of {name}": digest.hexdigest().encode(), f"raw {kind} of {name}": digest.digest()}
        found[f"base64 {kind} of {name}"] = base64.b64encode(digest.digest())
    return found


def needles(job: Path) -> tuple[Needles, Needles]:
    """Pixels of the photographs as numbers and as shown, and hashes of their files, of their pixels and of masks."""
    pixels, digests = Needles(), Needles()
    for file in sorted((job.parent / "capture").glob("*.npy")):
        values = np.load(file)
        digests |= hashes(file.name, file.read_bytes()) | hashes(f"pixels of {file.name}", values.tobytes())
        row = values[len(values) // 2]
        pixels |= {f"{file.name} {kind}": row.astype(kind).tobytes() for kind in ("<f4", "<f8", "<f2")}
        pixels |= {f"{file.name} channel {k}": row[:, k].astype("<f4").tobytes() for k in range(row.shape[-1])}
    for mask in sorted((job / "masks").glob("*.png")):
        digests |= hashes(mask.name, mask.read_bytes())
    for picture in read_pictures(job / "fit" / "pictures.npz"):
        of = f"{picture.camera} {picture.light}"
        middle = picture.photo.shape[0] // 2
        shares = [picture.photo, *np.moveaxis(picture.photo[..., None], 2, 0)]
        for k, photo in enumerate(shares):
            shown = tone_map(photo, white_level(photo, picture.valid))
            pixels[f"shown {of} {k}"] = shown[middle].tobytes()
    return pixels, digests


def contents(folder: Path) -> Iterator[bytes]:
    """Bytes of every file, and of every picture in one, decoded, at its own size and at each whole fraction of it."""
    for path in (path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        yield content
        pictures = [base64.b64decode(found) for found in DATA_URI.findall(content)]
        for picture in [*pictures, *([content] if path.suffix == ".png" else [])]:
            with Image.open(io.BytesIO(picture)) as opened:
                values = np.asarray(opened)
            for factor in range(1, 21):
                yield values[::factor, ::factor].tobytes()


def found(folder: Path, wanted: Needles) -> set[str]:
    return {name for content in contents(folder) for name, needle in wanted.items() if needle in content}


def test_no_byte_of_a_photograph_and_no_hash_of_one_leaves(job: Path, tmp_path: Path) -> None:
    pixels, digests = needles(job)
    given = tmp_path / "given"
    shutil.copytree(job / "asset", given)
    shutil.copy(job / "report.html", given)
    # The search finds what is there: the pictures that the report shows, and the SHA-256 of every photograph.
    shown = {name for name in pixels if name.startswith("shown")}
    assert found(given, pixels) == shown
    assert {name for name in digests if name.startswith("sha256 of") and "pixels" not in name} <= found(given, digests)
    folder = export_without_photographs(job)
    assert found(folder, pixels | digests) == set()
    for exporter in export_to(job, ("gltf", "blender"), with_photographs=False):
        assert found(exporter, pixels | digests) == set()
        assert not (exporter / BESIDE_PHOTOGRAPH).exists()


def test_all_else_goes_along_and_what_was_left_out_is_said(job: Path) -> None:
    folder = export_without_photographs(job, use="research")
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    published = {path.relative_to(job / "asset").as_posix() for path in (job / "asset").rglob("*") if path.is_file()}
    assert files == published - {BESIDE_PHOTOGRAPH} | {"report.html"}
    assert require_unedited(folder) == ()
    told = json.loads((folder / "provenance.json").read_text())
    assert told["photographs_left_out"] == 5  # two cameras, two lights, a mask
    assert told["use"] == "research"
    page = (folder / "report.html").read_text()
    assert "Photographs, and what shows their difference from a render, are left out of this report." in page
    assert "5 files, which are left out here with their hashes" in page
    assert 'alt="render, camera front' in page
    assert 'alt="photo' not in page
    assert 'alt="residual' not in page


def test_the_report_begins_with_the_render_beside_the_photograph(job: Path) -> None:
    page = (job / "report.html").read_text()
    picture = base64.b64encode((job / "asset" / BESIDE_PHOTOGRAPH).read_bytes()).decode()
    assert page.index(picture) < page.index("Error on held-out images")
    assert "Consent for research, until 9999-01-01." in page
    assert "P07" in page
    assert 'alt="photo, channel blue, camera front' in page


def test_an_export_needs_consent_and_says_it_in_one_sentence(job: Path) -> None:
    with pytest.raises(ConsentError, match="for research and not for film"):
        export_without_photographs(job, use="film")
    done = dentine("export", str(job), "--without-photographs", "--for", "film")
    assert done.returncode == SettingsError.exit_status
    (line,) = done.stderr.splitlines()
    assert line.startswith("dentine: The person's consent is for research and not for film; ")
    done = dentine("export", str(job), "--for", "film")
    assert "--for says what files that leave are for" in done.stderr


def test_a_consent_that_has_ended_is_told_when_the_asset_is_written_again(job: Path, tmp_path: Path) -> None:
    root = tmp_path / "again"
    shutil.copytree(job.parent, root)
    tree = json.loads((root / "capture" / "capture.json").read_text())
    write_tree(root / "capture", tree | {"consent": {"uses": ["research"], "until": "2020-01-01"}})
    before = (root / "job" / "asset" / "manifest.json").read_bytes()
    spec = JobSpec(capture=root / "capture", **OPTIONS | {"channels": None})
    with pytest.raises(ConsentError, match=r"ended on 2020-01-01; ask for a new one and write its date"):
        export(spec, LocalContext(root / "job", 2))
    assert (root / "job" / "asset" / "manifest.json").read_bytes() == before
