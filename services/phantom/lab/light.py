"""Radiance from the mouth of a virtual laboratory to a camera, under each of its lights.

The tooth that is measured is rendered by the engine with path tracing. The surfaces around it only have to look like
teeth, gums and lips, so they are shaded locally. No light passes between them and the measured tooth, as a fit of a
single tooth assumes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.fit.optics.parameters import Tissue
from services.fit.transport.engine import Engine
from services.fit.transport.rays import RayScene, pixel_rays
from services.fit.transport.scene.recipe import single_tooth
from services.phantom.lab.mouth import FITTED, LabMouth
from services.phantom.lab.rig import CHANNELS
from services.phantom.render import render_engine

Floats = NDArray[np.float64]
SUBPIXELS = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Positions x, y within a pixel at which rays are traced."""
TOOTH, GUMS, LIP, DARK = (0.75, 0.66, 0.52), (0.50, 0.24, 0.22), (0.45, 0.28, 0.27), (0.01, 0.01, 0.01)
"""Reflectances in red, green and blue of the shaded surfaces, and of the dark interior of the mouth."""
SMOOTHING_PX = 1.5
"""Standard deviation of the smoothing of rendered images, pixels. It is less than the spread of light inside a tooth,
and less than the squares of pixels that a fit reads."""
WRAP = 0.3
"""Amount by which light wraps around a shaded tooth: scattering inside a tooth softens the edge of its own shadow."""


class MouthLight:
    """Radiance of a mouth in the cameras of a rig, as ideal pinhole cameras see it."""

    def __init__(self, mouth: LabMouth, lights: tuple[CalibratedLight, ...], tissues: dict[str, Tissue]) -> None:
        self._lights, self._tissues = lights, tissues
        order = sorted(mouth.teeth, key=lambda tooth: tooth.fdi != FITTED)
        outers = [tooth.outer for tooth in order]
        self._all, self._alone = RayScene(*outers, mouth.gums, mouth.lips), RayScene(outers[0])
        self._colours = np.array([*[TOOTH] * len(outers), GUMS, LIP, DARK])
        self._wrap = np.array([*[WRAP] * len(outers), 0.0, 0.0, 0.0])
        tooth = mouth.fitted
        assert tooth.dentin is not None
        # Use one scene of unit intensities for all channels, because images are linear in each light's intensity.
        positions_mm, unit = np.array([light.position_mm for light in lights]), np.ones(len(lights))
        self._engine = Engine(single_tooth(tooth.outer, DentinShape.known(tooth.dentin), positions_mm, unit))

    def images(self, camera: CalibratedCamera, samples: int, seed: int) -> Floats:
        """Radiance (L, H, W, 3) under each light, averaged over the pixels.

        Args:
            camera: the camera, whose lens distortion is left out.
            samples: paths per pixel of the fitted tooth in green; red and blue get a quarter of them.
            seed: seed of the paths.
        """
        drawn, shaded, visible, unoccluded = self._shade_locally(camera)
        share = np.where(unoccluded > 0, visible / np.maximum(unoccluded, 1), 0.0)
        for channel, name in enumerate(CHANNELS):
            paths = samples if name == "green" else max(samples // 4, 1)
            own = render_engine(self._engine, self._tissues[name], camera, visible > 0, paths, seed)[0]
            intensity = np.array([light.intensity[channel] for light in self._lights])
            own = _smoothed(own * intensity[:, None, None], visible > 0, share)
            # Scale the shaded neighbours so that the tooth, shaded like them, has its rendered mean brightness.
            whole = visible == len(SUBPIXELS)
            scale = own[:, whole].sum() / max(float(shaded[:, whole, channel].sum()), 1e-30)
            teeth, others = drawn[0][..., channel], drawn[1][..., channel]
            drawn[1][..., channel] = own + scale * teeth + others
        return drawn[1]

    def _shade_locally(
        self, camera: CalibratedCamera
    ) -> tuple[tuple[Floats, Floats], Floats, NDArray[np.int64], NDArray[np.int64]]:
        """Shade everything by local illumination, without the engine.

        Returns:
            Radiance (L, H, W, 3) of the neighbouring teeth and of all other surfaces; that of the fitted tooth if it
            were shaded too; and for each pixel (H, W) the number of subpixels that see the fitted tooth, and the number
            that would see it without the surfaces in front of it.
        """
        width, height = camera.size
        neighbours, others, fitted = (np.zeros((len(self._lights), height * width, 3)) for _ in range(3))
        visible, unoccluded = (np.zeros(height * width, dtype=np.int64) for _ in range(2))
        last_tooth = len(self._colours) - 4
        for offset in SUBPIXELS:
            origin, directions = pixel_rays(camera, offset)
            hits = self._all.first_hits(origin, directions)
            unoccluded += self._alone.first_hits(origin, directions).hit
            visible += hits.mesh == 0
            for n, light in enumerate(self._lights):
                towards = np.array(light.position_mm) - hits.points_mm
                distance = np.linalg.norm(towards, axis=1)
                wrap = self._wrap[hits.mesh]
                cosine = ((hits.normals * towards).sum(axis=1) / distance + wrap) / (1 + wrap)
                lit = np.where(hits.hit, np.maximum(cosine, 0), 0.2) / (np.pi * distance**2) / len(SUBPIXELS)
                light_out = lit[:, None] * self._colours[hits.mesh] * np.array(light.intensity)
                for target, is_shown in (
                    (fitted, hits.mesh == 0),
                    (neighbours, (hits.mesh > 0) & (hits.mesh <= last_tooth)),
                    (others, (hits.mesh < 0) | (hits.mesh > last_tooth)),
                ):
                    target[n] += np.where(is_shown[:, None], light_out, 0.0)
        shape = (len(self._lights), height, width, 3)
        counts = visible.reshape(height, width), unoccluded.reshape(height, width)
        return (neighbours.reshape(shape), others.reshape(shape)), fitted.reshape(shape), *counts


def _smoothed(images: Floats, visible: NDArray[np.bool_], share: Floats) -> Floats:
    """Smooth the noise in images (L, H, W) of a tooth, and scale each pixel by the share (H, W) that shows the tooth.

    With a few hundred paths some pixels come out several times too bright. A sensor would clip them, which real light
    would not cause.
    """
    import cv2

    weight = cv2.GaussianBlur(visible.astype(np.float64), (0, 0), SMOOTHING_PX)
    smooth = [cv2.GaussianBlur(image * visible, (0, 0), SMOOTHING_PX) for image in images]
    return np.where(visible, np.stack(smooth) / np.maximum(weight, 1e-12), 0.0) * share
