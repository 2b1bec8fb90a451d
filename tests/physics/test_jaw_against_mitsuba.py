"""The phantom jaw rendered by the engine, which lets solids overlap, and by stock Mitsuba on surfaces that are cut
along each other, compared pixel by pixel.

The rule is that of ``tests.support.pictures``; a correct engine fails one run in 500, and seeds are fixed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from services.assets.mitsuba.mouth_scene import mouth_scene, write_mouth_surfaces
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.phantom.jaw import JawSurfaces, jaw_surfaces, known_mouth
from services.phantom.render import render_engine, render_mitsuba
from services.phantom.surface import PhantomSurface
from services.transport.engine import Engine
from services.transport.platform import prepare_device
from tests.support.pictures import pixel_scores, require_same_pictures
from tests.support.shared_data import shared_path

SUBJECT = 1
FRONT = (11, 12, 21)
BLOCK_PX = 4
"""Edge of the blocks in pixels. With so few paths the noise of a single pixel is skewed, differently in the two
renderers, which biases its z; sums over blocks are not skewed."""


def scores(jaw: JawSurfaces, folder: Path, *, pixel_mm: float, samples: int, block: int) -> np.ndarray:
    """z-scores of the images of two lights by one camera from the patient's right."""
    prepare_device()
    lights = dome_lights(2, ("green",), seed=SUBJECT)
    camera = dome_cameras(3, pixel_mm, tuple(tooth.outer for tooth in jaw.teeth))[0]
    mouth, fdi = known_mouth(jaw, "green", SUBJECT), tuple(tooth.fdi for tooth in jaw.teeth)
    files = write_mouth_surfaces(folder, jaw.teeth, jaw.gums, jaw.cavity)
    stock = render_mitsuba(
        mouth_scene(files, fdi, mouth, (camera,), lights[0].position_mm, 1.0), lights, 0, samples, seed=5
    )
    everything = np.ones(camera.size[::-1], dtype=bool)
    ours = render_engine(Engine(jaw.recipe(lights, 0, PhantomSurface())), mouth, camera, everything, samples, seed=6)
    return pixel_scores([ours[0], stock[0]], [ours[1], stock[1]], block)


@pytest.mark.slow
def test_front_teeth_in_their_gums_look_as_in_mitsuba(tmp_path: Path) -> None:
    whole = jaw_surfaces(SUBJECT)
    front = replace(whole, teeth=tuple(tooth for tooth in whole.teeth if tooth.fdi in FRONT))
    require_same_pictures(scores(front, tmp_path, pixel_mm=1.0, samples=512, block=2), least=150)


@pytest.mark.slow
def test_the_whole_jaw_looks_as_in_mitsuba(tmp_path: Path) -> None:
    require_same_pictures(scores(jaw_surfaces(SUBJECT), tmp_path, pixel_mm=1.0, samples=512, block=BLOCK_PX), least=120)


@pytest.mark.slow
def test_a_real_arch_whose_teeth_touch_looks_as_in_mitsuba(tmp_path: Path) -> None:
    jaw = jaw_surfaces(SUBJECT, shared_path("data/intraoral-arch/Example_01.vtp"))
    require_same_pictures(scores(jaw, tmp_path, pixel_mm=1.0, samples=512, block=BLOCK_PX), least=120)
