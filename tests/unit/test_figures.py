"""Figures for the paper: panels are in their places, the capture of a case holds what the case describes, and what
cannot be drawn is refused in a sentence.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.bench.figures import cases
from services.bench.figures.__main__ import FIGURES, chosen_figures, main, write_figure
from services.bench.figures.ambient import QUANTITIES, Row, sentence, table
from services.bench.figures.cases import Capture, Case, fingerprint, run_dentine, write_photographs
from services.bench.figures.drawings import Drawn
from services.bench.figures.environment import finer
from services.bench.figures.mosaic import GAP_PX, HEAD_PX, PAPER, Column, cropped, mosaic, photo_and_fit
from services.core.errors import DentineError, InputError
from services.core.geometry import Camera, Light
from services.core.pages.pictures import MASKED, Picture
from services.core.records import FolderCapture, ImageEntry
from services.core.store import read_record, write_record

SIZE = (4, 3)
"""Width and height of the small capture's images."""
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 100.0), (0.0, 0.0, 0.0, 1.0))


def camera(name: str = "c0") -> Camera:
    return Camera(name=name, size=SIZE, K=((50.0, 0.0, 2.0), (0.0, 50.0, 1.5), (0.0, 0.0, 1.0)), camera_from_world=POSE)


def plain(colour: tuple[int, int, int], height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), colour, dtype=np.uint8)


def picture(photo: float, render: float) -> Picture:
    valid = np.zeros((6, 8), dtype=bool)
    valid[2:5, 3:6] = True
    return Picture(
        "c0", "l0", False, np.where(valid, photo, 0.0)[..., None], np.where(valid, render, 0.0)[..., None], valid
    )


def test_every_picture_is_found_whole_and_enlarged_in_its_place() -> None:
    red, green, blue = (plain(colour, 5, 40) for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255)))
    page = mosaic([[red, green], [None, blue]], [Column("a"), Column("b", starts_group=True)], ["x", "y"], scale=2)
    places = {
        name: np.argwhere((page == colour).all(axis=-1))
        for name, colour in (("red", (255, 0, 0)), ("green", (0, 255, 0)), ("blue", (0, 0, 255)))
    }
    for name, place in places.items():
        (top, left), (bottom, right) = place.min(axis=0), place.max(axis=0)
        assert (bottom - top + 1, right - left + 1, len(place)) == (10, 80, 800), name
    assert places["red"][:, 0].min() == places["green"][:, 0].min() == HEAD_PX
    assert places["blue"][:, 0].min() == HEAD_PX + 10 + GAP_PX
    assert places["blue"][:, 1].min() == places["green"][:, 1].min()
    # Room before a group is wider than between pictures.
    assert places["green"][:, 1].min() - places["red"][:, 1].max() > 3 * GAP_PX
    assert tuple(page[-1, -1]) == PAPER


def test_smaller_pictures_are_centred() -> None:
    page = mosaic([[plain((255, 0, 0), 9, 31)], [plain((0, 0, 255), 3, 11)]], [Column("")], scale=1)
    rows, columns = np.nonzero((page == (0, 0, 255)).all(axis=-1))
    wide = np.nonzero((page == (255, 0, 0)).all(axis=-1))[1]
    assert abs((columns.min() - wide.min()) - (wide.max() - columns.max())) <= 2
    assert rows.max() - rows.min() == 2


@pytest.mark.parametrize(("rows", "names"), [([], ()), ([[None], [None, None]], ()), ([[None]], ("one", "two"))])
def test_uneven_rows_are_refused(rows: list[Any], names: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="needs as many pictures in every row"):
        mosaic(rows, [Column("a")], names)


def test_a_difference_has_the_sign_of_fit_minus_photograph_and_is_grey_off_the_tooth() -> None:
    photo, fit, difference = photo_and_fit(picture(0.5, 0.6))
    assert photo[3, 4].tolist() == [255, 255, 255]
    assert fit[3, 4].tolist() == [255, 255, 255]
    red, _, blue = difference[3, 4].astype(int)
    assert red > blue
    assert tuple(difference[0, 0]) == MASKED
    assert len(photo_and_fit(picture(0.5, 0.6), difference=False)) == 2


def test_a_picture_is_cut_to_what_is_valid() -> None:
    small = cropped(picture(0.5, 0.6))
    assert small.valid.shape == (5, 5)
    assert small.valid[1:-1, 1:-1].all()
    assert small.photo.shape == small.render.shape == (5, 5, 1)


def test_a_finer_camera_sees_the_same() -> None:
    coarse, fine = camera(), finer(camera(), 30)
    assert fine.size == (40, 30)
    points = np.array([[0.5, -1.0, 3.0], [-2.0, 1.0, 0.0]])
    np.testing.assert_allclose(fine.project(points)[0], 10 * coarse.project(points)[0])


def test_figures_are_chosen_in_the_order_of_the_paper() -> None:
    assert chosen_figures(None) == tuple(FIGURES)
    assert chosen_figures("fig10, fig8") == ("fig8", "fig10")


@pytest.mark.parametrize(("only", "words"), [("fig7", "Figure 'fig7' does not exist"), (" ,", "names no figure")])
def test_an_unknown_figure_is_refused_before_anything_is_rendered(
    only: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--out", str(tmp_path / "figures"), "--only", only]) == InputError.exit_status
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not (tmp_path / "figures").exists()


def test_a_figure_joins_the_page_of_those_that_are_there(tmp_path: Path) -> None:
    for name in ("fig10", "fig8"):
        write_figure(tmp_path, name, Drawn(plain((9, 9, 9), 2, 2), f"{name}: below 5 % & <fine>."))
    page = (tmp_path / "index.html").read_text()
    assert re.findall(r'src="(\w+)\.png"', page) == ["fig8", "fig10"]
    assert "below 5 % &amp; &lt;fine&gt;." in page


def written(folder: Path) -> FolderCapture:
    cameras, lights = (
        (camera("c0"), camera("c1")),
        tuple(Light(name=f"l{n}", position_mm=(0.0, 0.0, float(-n - 1)), intensity=(1.0,)) for n in range(3)),
    )
    images = []
    for c in cameras:
        for light in lights:
            stem = f"{c.name}_{light.name}"
            folder.mkdir(parents=True, exist_ok=True)
            lit = np.zeros((SIZE[1], SIZE[0], 1), dtype=np.float32)
            lit[1:] = 1.0
            np.save(folder / f"{stem}.npy", lit)
            np.save(folder / f"{stem}_var.npy", np.full_like(lit, 1e-6))
            images.append(
                ImageEntry(camera=c.name, light=light.name, file=f"{stem}.npy", variance_file=f"{stem}_var.npy")
            )
    (folder / "teeth" / "11").mkdir(parents=True)
    (folder / "teeth" / "11" / "outer.ply").write_text("ply\n")
    description = FolderCapture(units="mm", channels=("green",), cameras=cameras, lights=lights, images=tuple(images))
    write_record(folder / "capture.json", description)
    return description


def case(**changes: Any) -> Case:
    options: dict[str, Any] = {"cameras": ("c1",), "fitted_cameras": ("c1",), "fitted_lights": ("l0", "l2")} | changes
    return Case("small", Capture("small", {}), **options)


def test_photographs_of_a_case_are_noisy_marked_and_hold_what_was_added(tmp_path: Path) -> None:
    written(tmp_path / "all")
    added = np.full((SIZE[1], SIZE[0]), 0.25)
    write_photographs(tmp_path / "all", tmp_path / "some", case(), {"c1": added})
    found = read_record(tmp_path / "some" / "capture.json", FolderCapture)
    assert [c.name for c in found.cameras] == ["c1"]
    assert {image.light: image.held_out for image in found.images} == {"l0": False, "l1": True, "l2": False}
    image, variance = (np.load(tmp_path / "some" / f"c1_l0{kind}.npy")[1:] for kind in ("", "_var"))
    # Eight pixels with noise of 1 % and 0.2 % of the maximum: six standard errors of the mean.
    noise = 0.01**2 * 1.25**2 + 0.002**2 * 1.25**2
    assert image.mean() == pytest.approx(1.25, abs=6 * np.sqrt(noise / image.size))
    assert image.std() > 0
    np.testing.assert_allclose(variance, noise + 1e-6, rtol=1e-5)
    assert (tmp_path / "some" / "teeth" / "11" / "outer.ply").is_file()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cameras": ("c7",)}, "names camera c7"),
        ({"fitted_lights": ("l0", "l9")}, "names light l9"),
        ({"fitted_cameras": ("c0",)}, "holds every image out"),
    ],
)
def test_a_case_that_its_capture_cannot_give_is_refused(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    written(tmp_path / "all")
    with pytest.raises(InputError, match=words):
        write_photographs(tmp_path / "all", tmp_path / "some", case(**changes), {})


def test_a_finished_capture_is_used_again_and_other_options_are_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []

    def render(*arguments: str) -> None:
        called.append(arguments)
        folder = Path(arguments[arguments.index("--out") + 1])
        folder.mkdir()
        (folder / "capture.json").write_text("{}")

    monkeypatch.setattr(cases, "run_dentine", render)
    first, other = Capture("one", {"lights": 3, "stains": True, "gums": False}), Capture("one", {"lights": 4})
    assert first.arguments == ("--lights", "3", "--stains")
    assert first.rendered(tmp_path) == first.rendered(tmp_path) != other.rendered(tmp_path)
    assert [arguments[0] for arguments in called] == ["phantom", "phantom"]
    assert fingerprint(["a"]) != fingerprint(["b"])


def test_a_command_that_fails_is_named(tmp_path: Path) -> None:
    with pytest.raises(DentineError, match="dentine phantom ended with status"):
        run_dentine("phantom", "--out", str(tmp_path / "none"), "--lights", "0")


@pytest.fixture
def rows() -> list[Row]:
    def row(fraction: float, scale: Callable[[int], float]) -> Row:
        values = {quantity: {"value": 2.0 * scale(k), "se": 0.1, "truth": 1.9} for k, quantity in enumerate(QUANTITIES)}
        return {"fraction": fraction, "fit_error": 0.02, "held_out_error": 0.03 + fraction} | values

    return [row(0.0, lambda _: 1.0), row(0.05, lambda k: 1.0 + 0.1 * k)]


def test_ambient_light_is_said_by_its_strength_and_what_was_found_of_the_truth(rows: list[Row]) -> None:
    said = sentence(rows)
    assert "without it 1.05 ± 0.05, 1.05 ± 0.05, 1.05 ± 0.05, 1.05 ± 0.05, held-out error 3.0 %;" in said
    assert said.endswith(
        "with 5 % of the mean radiance 1.05 ± 0.05, 1.16 ± 0.05, 1.26 ± 0.05, 1.37 ± 0.05, held-out error 8.0 %."
    )
    lines = table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert "| 5 % | 2 ± 0.1 | 2.2 ± 0.1 | 2.4 ± 0.1 | 2.6 ± 0.1 | 2.0 % | 8.0 % |" in lines
