"""Fitted teeth in light other than a dome's: under a photographed environment, with the highlights that a fit does not
model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from services.bench.figures.drawings import Drawn
from services.bench.figures.figure_cases import FigureCases
from services.bench.figures.fitted import Fitted
from services.bench.figures.gallery import SIMILAR_G
from services.bench.figures.mosaic import Column, mosaic
from services.bench.figures.surroundings import environment_light, read_environment, render_under
from services.core.geometry import Camera, Mesh
from services.core.pages.pictures import tone_map, white_level
from services.fit.coordinates.domain import similar_tissue
from services.phantom.surface import ENAMEL_ROUGHNESS
from services.transport.optics.parameters import Tissue

MEMORIAL = Path("shared") / "data" / "hdr-memorial" / "memorial.hdr"
TURNS_DEGREES = (0.0, 120.0, 240.0)


def memorial() -> Path | None:
    """Return the file of the environment; None where this data does not lie beside the checkout."""
    path = Path(__file__).resolve().parents[4] / MEMORIAL
    return path if path.is_file() else None


def under_an_environment(cases: FigureCases) -> Drawn:
    """Draw the tooth of fig. 10 under an environment in three orientations, without and with mirror reflection.

    Raises:
        InputError: the environment's file does not exist.
    """
    fitted = Fitted(cases.five_lights.fitted(cases.work))
    environment = read_environment(memorial() or MEMORIAL)
    (tooth,), (dentin,) = fitted.observations.teeth, fitted.dentins()
    surfaces = {"outer": tooth.outer} | (
        {} if dentin is None else {"dentin": Mesh(dentin.vertices_mm(fitted.report.shape), dentin.base.faces)}
    )
    camera = finer(fitted.observations.manifest.cameras[1], cases.effort.environment_px)
    rows = []
    for roughness in (None, ENAMEL_ROUGHNESS):
        images = []
        for turn in TURNS_DEGREES:
            channels = []
            for k, channel in enumerate(fitted.channels):
                tissue = fitted.optics(channel)
                assert isinstance(tissue, Tissue)
                options = {
                    "samples": cases.effort.environment_samples,
                    "boundary": fitted.spec.boundary,
                    "ior": fitted.spec.ior,
                    "roughness": roughness,
                }
                light = environment_light(environment[..., k], turn)
                channels.append(render_under(light, surfaces, similar_tissue(tissue, SIMILAR_G), camera, **options))  # type: ignore[arg-type]
            images.append(np.stack(channels, axis=-1))
        rows.append(images)
    width, height = camera.size
    middle = np.zeros((height, width), dtype=bool)
    middle[height // 4 : 3 * height // 4, width // 3 : 2 * width // 3] = True
    pictures = [[tone_map(image, white_level(rows[-1][k], middle)) for k, image in enumerate(row)] for row in rows]
    columns = [Column(f"turned by {turn:.0f} degrees") for turn in TURNS_DEGREES]
    return Drawn(
        mosaic(pictures, columns, ["fitted", "with GGX"], scale=1),
        f"The tooth of fig10 ({cases.tooth_name}, fitted in colour) under the light of a church, an ordinary photograph"
        " wrapped around it, turned three ways; above as a fit sees teeth, below with the mirror image in its enamel"
        f" put back (GGX, roughness {ENAMEL_ROUGHNESS:g}). By similar media of mean cosine {SIMILAR_G:g}.",
    )


def finer(camera: Camera, height_px: int) -> Camera:
    """Return the camera with pixels of another size, so that its image has about this height."""
    factor = height_px / camera.size[1]
    size = (max(round(camera.size[0] * factor), 1), max(round(camera.size[1] * factor), 1))
    K = np.diag([factor, factor, 1.0]) @ np.asarray(camera.K)
    return camera.model_copy(update={"size": size, "K": tuple(tuple(float(v) for v in row) for row in K)})
