"""What it costs to show a tooth that was fitted with the boundary ``thin`` by a dielectric, as renderers have one.

python -m tests.benchmarks.thin_as_glass --json glass.json [--paths 256] [--seeds 2] [--surfaces NAME ...]

Stock Mitsuba (``prbvolpath``) renders a virtual incisor with the shipped ``thin_boundary.py``, with ``dielectric`` and
with ``roughdielectric`` of alpha 0.12, of the same index and media, in two views under an even sky, a large lamp in
front and one behind. A row holds the picture ÷ that of the thin boundary (mean over the tooth, by channel), its
standard error from the seeds, and the median and 95th percentile of ΔE00 over squares of 4 mm. White is the
brightest square of the thin boundary's picture. ``absorption`` is the factor on the media's absorption. The surface
``blender`` is what the script for Blender shows with ``--surface glass`` under the sky; it needs ``make clients``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.incisor import build_incisor
from services.assets.mitsuba.dielectric import ABSORPTION
from services.assets.mitsuba.scene import medium_dict, sensor_dict
from services.assets.mitsuba.shipped.thin_boundary import register
from services.core.files.meshes import write_mesh
from services.core.store import write_atomic
from services.transport.optics.parameters import Medium, Tissue
from services.transport.platform import prepare_device
from tests.support.cycles_scenes import Case, cycles_image, write_case
from tests.support.small_tooth import camera_at

IOR, ROUGHNESS = 1.631, 0.12
MEDIA = {
    "red": (Medium(4.2, 0.998, g1=0.8), Medium(11.0, 0.9965, g1=0.75)),
    "green": (Medium(4.5, 0.997, g1=0.8), Medium(12.0, 0.9945, g1=0.75)),
    "blue": (Medium(5.0, 0.9955, g1=0.8), Medium(13.0, 0.9905, g1=0.75)),
}
"""Enamel and dentin of the example on the page docs/use/rendering.md, which is of a thin boundary."""
SURFACES = {
    "thin": {"type": "thin_boundary", "ior": IOR},
    "dielectric": {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0},
    "roughdielectric": {"type": "roughdielectric", "int_ior": IOR, "ext_ior": 1.0, "alpha": ROUGHNESS},
}
BLENDER = "blender"
VIEWS = ((0.2, 1.0, 0.15), (-0.9, 0.7, -0.2))
LIGHTS = {"sky": None, "lamp before it": (700.0, 700.0, 300.0), "lamp behind it": (-250.0, -850.0, 200.0)}
LAMP_MM = 400.0
"""Radius of the lamps, which a path from inside a dielectric must hit by chance."""
SIZE, SQUARE = 16, 4
"""Edges of picture and squares, pixels of 1 mm."""
Array = NDArray[np.float64]


def image_of(folder: Path, view: int, light: str, surface: str, factor: float, paths: int, seed: int) -> Array:
    """Radiance (H, W, 3)."""
    import mitsuba as mi

    planes = []
    for enamel, dentin in MEDIA.values():
        media = [_absorbing(medium, factor) for medium in (enamel, dentin)]
        lamp: dict[str, Any] = {"type": "constant", "radiance": 1.0}
        if (place := LIGHTS[light]) is not None:
            lamp = {"type": "sphere", "center": list(place), "radius": LAMP_MM,
                    "emitter": {"type": "area", "radiance": 10.0}}  # fmt: skip
        sensor = sensor_dict(camera_at(VIEWS[view], size=SIZE, span_mm=16.0), paths)
        outside, inside = ({"type": "ref", "id": name} for name in ("enamel", "dentin"))
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "prbvolpath", "max_depth": 5000, "rr_depth": 100},
                "lamp": lamp,
                "enamel": medium_dict(media[0]),
                "dentin": medium_dict(media[1]),
                "outer": {"type": "ply", "filename": str(folder / "outer.ply"), "face_normals": True,
                          "bsdf": SURFACES[surface], "interior": outside},
                "inner": {"type": "ply", "filename": str(folder / "dentin.ply"), "face_normals": True,
                          "bsdf": {"type": "null"}, "interior": inside, "exterior": outside},
                "camera": sensor | {"to_world": mi.ScalarTransform4f(sensor["to_world"])},
            },
            optimize=False,
        )  # fmt: skip
        planes.append(np.array(mi.render(scene, spp=paths, seed=seed), dtype=np.float64)[..., 0])
    return np.stack(planes, axis=-1)


def blender_image(folder: Path, view: int, paths: int, seed: int) -> Array:
    """Radiance (H, W, 3) under the sky by the script for Blender, whose conversion has its own factor."""
    incisor = build_incisor(24)
    case = Case(
        incisor.outer,
        incisor.dentin,
        tuple(Tissue(*media) for media in MEDIA.values()),
        camera_at(VIEWS[view], size=SIZE, span_mm=16.0),
        boundary="thin",
        words=("--surface", "glass"),
    )
    if not (folder / "rig.json").is_file():
        write_case(folder, case)
    return cycles_image(folder, case, paths, seed)


def _absorbing(medium: Medium, factor: float) -> Medium:
    """The medium with so many times its absorption, and its scattering as it is."""
    scattering, absorption = medium.sigma * medium.alpha, medium.sigma * (1 - medium.alpha) * factor
    sigma = scattering + absorption
    return Medium(sigma, scattering / sigma, medium.beta, medium.g1, medium.g2)


def differences(image: Array, truth: Array, covered: NDArray[np.bool_]) -> Array:
    """ΔE00 (N,) of linear sRGB colours, means over the covered pixels of squares that are covered by half."""
    import colour

    def means(values: Array) -> Array:
        squares = values.reshape(SIZE // SQUARE, SQUARE, SIZE // SQUARE, SQUARE, -1)
        return np.asarray(squares.sum(axis=(1, 3)).reshape(-1, squares.shape[-1]))

    count = means(covered.astype(np.float64)[..., None])
    full = count[:, 0] >= SQUARE**2 / 2
    ours, theirs = ((means(one * covered[..., None]) / np.maximum(count, 1))[full] for one in (image, truth))
    white = theirs.max()
    lab = [colour.XYZ_to_Lab(colour.RGB_to_XYZ(one / white, "sRGB")) for one in (ours, theirs)]
    return np.asarray(colour.delta_E(lab[0], lab[1], method="CIE 2000"))


def main() -> None:
    """Render, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--paths", type=int, default=256)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--absorption", type=float, nargs="+", default=[1.0])
    parser.add_argument("--surfaces", nargs="+", default=["dielectric", "roughdielectric"])
    options = parser.parse_args()
    prepare_device()
    register()
    incisor, rows = build_incisor(24), list[dict[str, Any]]()
    with TemporaryDirectory() as place:
        folder = Path(place)
        write_mesh(folder / "outer.ply", incisor.outer)
        write_mesh(folder / "dentin.ply", incisor.dentin)
        for view in range(len(VIEWS)):
            for light in LIGHTS if set(options.surfaces) != {BLENDER} else ["sky"]:
                seeds = range(options.seeds)
                thin = np.stack([image_of(folder, view, light, "thin", 1.0, options.paths, k) for k in seeds])
                covered = _covered(folder, view)
                for surface in options.surfaces:
                    for factor in [ABSORPTION] if surface == BLENDER else options.absorption:
                        if surface != BLENDER:
                            found = [
                                image_of(folder, view, light, surface, factor, options.paths, 99 + k) for k in seeds
                            ]
                        elif LIGHTS[light] is None:
                            found = [
                                blender_image(folder / f"blender-{view}", view, options.paths, 99 + k) for k in seeds
                            ]
                        else:
                            continue
                        ratios = np.array([a[covered].mean(axis=0) / b[covered].mean(axis=0)
                                           for a, b in zip(found, thin, strict=True)])  # fmt: skip
                        delta = differences(np.mean(found, axis=0), thin.mean(axis=0), covered)
                        rows.append(
                            {
                                "view": view, "light": light, "surface": surface, "absorption": factor,
                                "ratio": ratios.mean(axis=0).round(3).tolist(),
                                "se": (ratios.std(axis=0, ddof=1) / np.sqrt(len(ratios))).round(3).tolist(),
                                "median": round(float(np.median(delta)), 2),
                                "most": round(float(np.percentile(delta, 95)), 2),
                            }
                        )  # fmt: skip
                        print(rows[-1], flush=True)
                        write_atomic(options.json, json.dumps(rows, indent=1).encode())


def _covered(folder: Path, view: int) -> NDArray[np.bool_]:
    from services.core.files.meshes import read_mesh
    from services.transport.rays import RayScene, pixel_rays

    camera, scene = camera_at(VIEWS[view], size=SIZE, span_mm=16.0), RayScene(read_mesh(folder / "outer.ply"))
    corners = [scene.first_hits(*pixel_rays(camera, (x, y))).hit for x in (0.01, 0.99) for y in (0.01, 0.99)]
    return np.asarray(np.all(corners, axis=0).reshape(camera.size[1], camera.size[0]))


if __name__ == "__main__":
    main()
