"""The report states the most important result first, and opens without any other file."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.assets.curves import Series, log_chart
from services.assets.report_page import THIN_CAVEAT, ReportPictures, write_report
from services.core.pages.pictures import Picture
from services.core.results import Correlation, Estimate, FitReport
from services.transport.thickness import ThicknessMap

HISTORY = [
    {"channel": "green", "stage": "homogeneous", "step": 1, "loss": 0.2, "held_out_error": 0.3},
    {"channel": "green", "stage": "layered", "step": 2, "loss": 0.02, "held_out_error": None},
    {"channel": "green", "stage": "layered", "step": 3, "loss": 0.002, "held_out_error": 0.04, "held_out_se": 0.013},
]


class Page(HTMLParser):
    """Text, addresses and tags of a page; unclosed tags fail."""

    VOID = ("meta", "img", "line", "polyline", "circle", "br", "link")

    def __init__(self, source: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(source)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] != "style":
            self.text += data


def report(**changes: Any) -> FitReport:
    table = {
        "enamel.sigma": Estimate(value=4.512, se=0.314, unit="1/mm", determined=True),
        "enamel.alpha": Estimate(value=0.997051, se=0.000042, unit="1", determined=True),
        "enamel.g1": Estimate(value=0.79, se=0.21, unit="1", determined=False),
        "enamel.beta": Estimate(value=1.0, se=None, unit="1", determined=False),
        "enamel.sigma_s_reduced": Estimate(value=0.9021, se=0.0243, unit="1/mm", determined=True),
        "shape.1": Estimate(value=0.4, se=0.1, unit="1", determined=True),
    }
    whole: dict[str, Any] = {
        "converged": True,
        "advice": "",
        "parameters": {"green": table},
        "fit_error": {"green": 0.0234},
        "held_out_error": {"green": 0.0412},
    }
    return FitReport(**whole | {"steps": 12, "seconds": 421.0} | changes)


def pictures(**changes: Any) -> ReportPictures:
    photo = np.random.default_rng(0).uniform(0.1, 0.2, (6, 5, 1))
    valid = np.ones((6, 5), dtype=bool)
    shown = tuple(
        Picture("c0", light, held_out, photo, 1.1 * photo, valid) for light, held_out in (("l1", False), ("l3", True))
    )
    return ReportPictures(**{"channels": ("green",), "pictures": shown} | changes)


def thickness(**changes: Any) -> ThicknessMap:
    mean = Estimate(value=0.7, se=0.06, unit="mm", determined=True)
    whole: dict[str, Any] = {"image_mm": np.full((6, 5), 0.7), "errors_mm": np.full((6, 5), 0.08), "mean": mean}
    return ThicknessMap(**whole | changes)


def page(path: Path, fit: FitReport, shown: ReportPictures, **context: Any) -> Page:
    write_report(path / "report.html", fit, shown, HISTORY, {"title": "Tooth 11", "boundary": "matched"} | context)
    return Page((path / "report.html").read_text(encoding="utf-8"))


def test_the_page_needs_nothing_else_and_knows_both_schemes(tmp_path: Path) -> None:
    shown = page(tmp_path, report(), pictures(thickness=thickness(), camera="c0"))
    assert len(shown.addresses) == 8
    assert all(address.startswith("data:image/png;base64,") for address in shown.addresses)
    assert not {"script", "link", "iframe"} & set(shown.tags)
    source = (tmp_path / "report.html").read_text()
    assert "prefers-color-scheme: dark" in source
    assert not re.search(r"https?://|@import|url\(", source)


def test_thickness_is_given_with_its_error(tmp_path: Path) -> None:
    text = page(tmp_path, report(), pictures(thickness=thickness(), camera="c0")).text
    assert "seen by camera c0; mean 0.70 ± 0.06 mm" in text
    assert "Its standard error, seen by camera c0; mean 0.08 mm" in text
    known = thickness(errors_mm=None, mean=Estimate(value=0.7, se=None, unit="mm", determined=True))
    text = page(tmp_path, report(), pictures(thickness=known, camera="c0")).text
    assert "mean 0.70 mm" in text
    assert "standard error, seen" not in text


def test_held_out_error_leads(tmp_path: Path) -> None:
    text = page(tmp_path, report(), pictures()).text
    assert text.index("4.1 %") < text.index("2.3 %") < text.index("Parameters")
    assert "did not converge" not in text


def test_errors_on_the_way_come_with_their_noise(tmp_path: Path) -> None:
    text = " ".join(page(tmp_path, report(), pictures()).text.split())
    assert "homogeneousgreen10.230.0 % layeredgreen30.0024.0 ± 1.3 %" in text


def test_a_fit_that_did_not_converge_says_so_first(tmp_path: Path) -> None:
    text = page(tmp_path, report(converged=False, advice="Raise max_steps."), pictures()).text
    assert text.index("The fit did not converge. Raise max_steps.") < text.index("4.1 %")


def test_without_held_out_images_no_number_pretends(tmp_path: Path) -> None:
    text = page(tmp_path, report(held_out_error={}), pictures()).text
    assert "nothing tests the result" in text
    assert text.index("none") < text.index("2.3 %")


def test_numbers_carry_error_unit_and_flag(tmp_path: Path) -> None:
    text = " ".join(page(tmp_path, report(), pictures()).text.split())
    assert "4.51 ± 0.31 1/mm" in text
    assert "0.997051 ± 0.000042" in text
    assert "0.79 ± 0.21 not determined" in text
    assert "1 not fitted" in text
    assert text.index("reduced scattering") < text.index("extinction")
    assert "weight c, proximal" in text


def test_what_is_told_and_what_goes_together_are_shown(tmp_path: Path) -> None:
    found = Correlation(
        names=("enamel.sigma", "enamel.alpha", "shape.1"),
        matrix=((1.0, -0.92, 0.1), (-0.92, 1.0, 0.0), (0.1, 0.0, 1.0)),
    )
    fit = report(
        told="This capture tells a lot.", next_capture="A light above would help most.", correlations={"green": found}
    )
    text = " ".join(page(tmp_path, fit, pictures()).text.split())
    assert text.index("This capture tells a lot. A light above would help most.") < text.index("Parameters")
    assert "greenenamel σenamel αc proximal enamel σ1−0.92+0.10 enamel α−0.921+0.00" in text
    assert "What goes together" not in page(tmp_path, report(), pictures()).text


@pytest.mark.parametrize(("boundary", "expected"), [("thin", True), ("matched", False)])
def test_the_thin_boundarys_bias_is_told(tmp_path: Path, boundary: str, expected: bool) -> None:
    assert (THIN_CAVEAT in page(tmp_path, report(), pictures(), boundary=boundary, ior=1.631).text) is expected


def test_names_from_outside_cannot_inject_markup(tmp_path: Path) -> None:
    shown = page(
        tmp_path,
        report(advice="<script>a</script>", converged=False),
        pictures(),
        title="<b>T</b>",
        provenance={"<i>": "<img src=x>"},
    )
    assert "script" not in shown.tags
    assert "x" not in shown.addresses
    assert "<b>T</b>" in shown.text


def test_a_picture_without_signal_still_makes_a_page(tmp_path: Path) -> None:
    dark = Picture("c0", "l9", True, np.zeros((4, 4, 1)), np.zeros((4, 4, 1)), np.zeros((4, 4), dtype=bool))
    assert "l9" in page(tmp_path, report(), pictures(pictures=(dark,))).text


def test_chart_puts_larger_losses_higher_and_leaves_out_what_has_no_logarithm() -> None:
    chart = log_chart(
        "Loss", "step", "loss", [Series("green", ((1, 1.0), (2, 0.1), (3, 0.0), (4, 0.01))), Series("empty", ())]
    )
    (points,) = re.findall(r'points="([^"]+)"', chart)
    heights = [float(point.split(",")[1]) for point in points.split()]
    assert len(heights) == 3
    assert heights == sorted(heights)
    assert heights[1] - heights[0] == pytest.approx(heights[2] - heights[1], abs=0.2)
    assert log_chart("Loss", "step", "loss", [Series("green", ((1, 0.0),))]) == ""
