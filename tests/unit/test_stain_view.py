"""Which texels of a stain texture the pixels of a view show."""

from __future__ import annotations

import numpy as np

from services.transport.scene.recipe import View
from services.transport.scene.stain_uv import stain_layout
from services.transport.stain_view import seen_texels
from tests.support.prepared import SIZE, camera, sphere


def test_a_pixel_shows_the_texels_at_its_place() -> None:
    layout, own = stain_layout(sphere(4.0), 0.5), camera("c0")
    view = View(own, np.argwhere(np.ones(SIZE)).astype(np.int32))
    shares = seen_texels(layout, view)
    total = np.asarray(shares.sum(axis=1)).reshape(-1)
    assert shares.shape == (len(view), len(layout.points_mm))
    assert total.min() >= 0.0
    assert total.max() <= 1.0 + 1e-9
    whole = total > 0.99
    assert whole.sum() > 20
    # The mean of the seen texels' places projects into the pixel, to within the half texel (one pixel of 0.5 mm) by
    # which a texel at the edge of a chart may lie beside the points that read it.
    places = (shares @ layout.points_mm)[whole] / total[whole, None]
    pose, intrinsic = np.array(own.camera_from_world), np.array(own.K)
    seen = places @ pose[:3, :3].T + pose[:3, 3]
    found = (seen @ intrinsic.T)[:, :2] / seen[:, 2:]
    off = np.linalg.norm(found - (view.pixels[whole] + 0.5), axis=1)
    assert np.median(off) < 0.3
    assert off.max() < 1.0
