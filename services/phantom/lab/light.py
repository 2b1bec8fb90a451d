"""Radiance from the mouth of a virtual laboratory to a camera, under each of its lights.

The teeth are rendered by the engine with path tracing, with light passing between them and their gums. Pixels that show
gums, lips or the retractor only have to look like them, so they are shaded locally.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.anatomy.dentin_shape import DentinShape
from services.core.calibration.cameras_and_lights import CalibratedCamera, CalibratedLight
from services.core.geometry import Tooth
from services.phantom.jaw_optics import GUMS_IOR
from services.phantom.lab.mouth import LabMouth
from services.phantom.lab.rig import CHANNELS
from services.phantom.render import render_engine
from services.transport.engine import Engine
from services.transport.optics.parameters import Mouth
from services.transport.rays import RayScene, pixel_rays
from services.transport.scene.recipe import SceneRecipe, ToothSurfaces

Floats = NDArray[np.float64]
SUBPIXELS = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
"""Positions x, y within a pixel at which rays are traced."""
GUMS, LIP, DARK = (0.50, 0.24, 0.22), (0.45, 0.28, 0.27), (0.01, 0.01, 0.01)
"""Reflectances in red, green and blue of the shaded surfaces, and of the dark interior of the mouth."""
SMOOTHING_PX = 1.5
"""Standard deviation of the smoothing of rendered images, pixels. It is less than the spread of light inside a tooth,
and less than the squares of pixels that a fit reads."""
FEWER_PATHS = 4
"""Ratio of the paths of the measured tooth in green to those of other teeth, and to those in red and blue."""


class MouthLight:
    """Radiance of a mouth in the cameras of a rig, as ideal pinhole cameras see it."""

    def __init__(self, mouth: LabMouth, lights: tuple[CalibratedLight, ...], media: dict[str, Mouth]) -> None:
        """Take the media of teeth and gums by channel, the teeth in the order of the mouth's."""
        self._lights, self._media, self._teeth = lights, media, len(mouth.teeth)
        self._surfaces = RayScene(*(tooth.outer for tooth in mouth.teeth), mouth.shown_gums, mouth.lips)
        # Use one scene of unit intensities for all channels, because images are linear in each light's intensity.
        positions_mm, unit = np.array([light.position_mm for light in lights]), np.ones(len(lights))
        teeth = map(_surfaces, mouth.teeth)
        self._engine = Engine(SceneRecipe(tuple(teeth), positions_mm, unit, gums=mouth.gums, gums_ior=GUMS_IOR))

    def images(self, camera: CalibratedCamera, samples: int, seed: int) -> Floats:
        """Radiance (L, H, W, 3) under each light, averaged over the pixels.

        Args:
            camera: the camera, whose lens distortion is left out.
            samples: paths per pixel of the measured tooth in green; red, blue and the other teeth get fewer.
            seed: seed of the paths.
        """
        drawn, visible = self._shade_locally(camera)
        for channel, name in enumerate(CHANNELS):
            intensity = np.array([light.intensity[channel] for light in self._lights])
            for tooth, count in enumerate(visible):
                paths = max(samples // FEWER_PATHS ** ((name != "green") + (tooth > 0)), 1)
                whole = count == len(SUBPIXELS)
                own = render_engine(self._engine, self._media[name], camera, whole, paths, seed)[0]
                shown = _smoothed(own * intensity[:, None, None], whole) * (count / len(SUBPIXELS))
                drawn[..., channel] += shown
        return drawn

    def _shade_locally(self, camera: CalibratedCamera) -> tuple[Floats, NDArray[np.int64]]:
        """Shade everything but the teeth by local illumination, without the engine.

        Returns:
            Radiance (L, H, W, 3), and for each tooth and pixel (T, H, W) the number of subpixels that see the tooth.
        """
        width, height = camera.size
        drawn = np.zeros((len(self._lights), height * width, 3))
        visible = np.zeros((self._teeth, height * width), dtype=np.int64)
        colours = np.array([GUMS, LIP, DARK])
        for offset in SUBPIXELS:
            origin, directions = pixel_rays(camera, offset)
            hits = self._surfaces.first_hits(origin, directions)
            visible += hits.mesh == np.arange(self._teeth)[:, None]
            is_tooth = hits.hit & (hits.mesh < self._teeth)
            colour = colours[np.where(hits.hit & ~is_tooth, hits.mesh - self._teeth, len(colours) - 1)]
            for n, light in enumerate(self._lights):
                towards = np.array(light.position_mm) - hits.points_mm
                distance = np.linalg.norm(towards, axis=1)
                cosine = (hits.normals * towards).sum(axis=1) / distance
                lit = np.where(hits.hit, np.maximum(cosine, 0), 0.2) / (np.pi * distance**2) / len(SUBPIXELS)
                drawn[n] += np.where(is_tooth, 0.0, lit)[:, None] * colour * np.array(light.intensity)
        shape = (len(self._lights), height, width, 3)
        return drawn.reshape(shape), visible.reshape(self._teeth, height, width)


def _surfaces(tooth: Tooth) -> ToothSurfaces:
    assert tooth.dentin is not None, "all teeth of the mouth have dentin"
    return ToothSurfaces(tooth.outer, DentinShape.known(tooth.dentin))


def _smoothed(images: Floats, whole: NDArray[np.bool_]) -> Floats:
    """Smooth the noise in images (L, H, W) of a tooth, and continue them to its rim from the pixels (H, W) it fills.

    With a few hundred paths some pixels come out several times too bright. A sensor would clip them, which real light
    would not cause.
    """
    import cv2

    weight = cv2.GaussianBlur(whole.astype(np.float64), (0, 0), SMOOTHING_PX)
    smooth = [cv2.GaussianBlur(image * whole, (0, 0), SMOOTHING_PX) for image in images]
    return np.asarray(np.stack(smooth) / np.maximum(weight, 1e-12))
