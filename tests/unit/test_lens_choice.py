"""Which distortion model a camera gets, and what its report says of what is not known."""

from __future__ import annotations

import numpy as np
import pytest

from services.calibrate.cameras.lens import Lens
from services.calibrate.cameras.models import choose_lens
from services.calibrate.session.boards import describe_model
from services.calibrate.session.drawings import uncertainty_drawing
from tests.support.board_sessions import SIZE, photographed, true_rig

MODELS = ("radial-tangential-4", "radial-tangential-5", "rational-8")


@pytest.mark.parametrize("seed", [14, 17])
def test_a_richer_lens_must_be_better_beyond_its_error(seed: int) -> None:
    """Of a lens with four coefficients eight are found, up to 4,800, whose held-out error is 0.3 % smaller."""
    random = np.random.default_rng(seed)
    views = [view for view in photographed(true_rig(random, n_places=8), 0.2, random) if view.camera == 1]
    choice = choose_lens(views, SIZE, "middle", models=MODELS)
    assert choice.held_out_px["rational-8"] < choice.held_out_px["radial-tangential-4"]
    assert choice.lens.model == "radial-tangential-4"


@pytest.mark.parametrize(
    ("distortion", "keeps_order"),
    [
        ((), True),
        ((-0.3, 0.1, 0.0, 0.0), True),
        # r (1 - r²) turns back at r = 0.58, and the corner lies at 0.80.
        ((-1.0, 0.0, 0.0, 0.0), False),
        # r / (1 + 4 r²) turns back at r = 0.5.
        ((0.0, 0.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0), False),
    ],
)
def test_a_lens_that_folds_its_image_is_known(distortion: tuple[float, ...], keeps_order: bool) -> None:
    lens = Lens((640, 480), np.array([500.0, 500.0, 320.0, 240.0, *distortion]))
    assert lens.keeps_order == keeps_order


def test_a_model_that_folds_the_image_is_left_out_and_said() -> None:
    random = np.random.default_rng(7)
    views = [view for view in photographed(true_rig(random, n_places=8), 0.2, random) if view.camera == 1]
    choice = choose_lens(views, SIZE, "middle", models=MODELS)
    assert choice.folding == ("rational-8",)
    assert describe_model(choice).endswith("; left out, as they fold the image: rational-8")


def test_an_uncertainty_that_means_nothing_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    class Fit:
        class rig:  # noqa: N801
            lenses = (Lens((640, 480), np.array([500.0, 500.0, 320.0, 240.0])),)

    sigma = np.full(192, 0.1)
    sigma[[0, 5]] = 483263411.929, 0.25
    monkeypatch.setattr("services.calibrate.session.drawings.projection_sigma", lambda *_: sigma)
    drawing, largest = uncertainty_drawing(Fit(), 0, 500.0)  # type: ignore[arg-type]
    assert largest == 0.25
    assert "483263411" not in drawing
    assert drawing.count("<title>not known</title>") == 1
