"""Pictures of a tooth in an ordinary Mitsuba scene, by the ``dentine`` integrator.

``python -m services.bench.figures.gallery --out DIR`` puts an incisor on a table and writes one PNG per view and
surface, and ``gallery.png`` with all: above the thin boundary, which does not refract, and below a rough dielectric of
the same index and media. The options ``--outer`` and ``--dentin`` give another tooth and ``--environment`` other
surroundings. With ``--scene FILE.xml --enamel ID --core ID`` the shapes of these ids in your own scene become a tooth,
and every sensor gives a picture.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.frame import estimate_frame
from services.anatomy.templates.incisor import build_incisor
from services.bench.figures.mosaic import Column, mosaic
from services.core.errors import DentineError, InputError, NonFiniteError
from services.core.files.meshes import read_mesh, write_mesh
from services.core.geometry import Mesh, Vector3
from services.core.pages.pictures import png_bytes, tone_map, white_level
from services.core.store import write_atomic
from services.fit.coordinates.domain import similar_medium, similar_tissue
from services.phantom.tooth import TRUE_TISSUE
from services.transport.platform import prepare_device

SceneDict = dict[str, Any]
Image = NDArray[np.float64]

SURFACES = {"thin": "", "rough": "-rough"}
"""Surfaces of the tooth in the pictures, in the order of their rows, and the ending that each adds to a file's name."""
COLUMNS = 120
"""Columns of the procedural incisor's mesh: enough for an outline without visible corners."""
ROUGHNESS = 0.12
"""GGX roughness of the enamel's surface."""
TABLE_GAP_MM = 0.02
"""Gap between tooth and table: a tooth that touches nothing has room for its own distance grid."""
SIMILAR_G = 0.25
"""Mean cosine of the similar media with which pictures are rendered. They are 1 to 3 % darker here, and cost about a
sixth for equal noise."""
ROUGH_DIVISOR = 8
"""Divisor of the paths per pixel of the rough surface, whose pictures are smoothed and have a render for each channel.
"""
PASS_SAMPLES = 32
"""Paths per pixel of one pass of a render."""
SIZE_PX = (320, 400)
"""Default width and height of a picture."""
SHOWN_MM = 13.6
"""Largest height of the tooth above the table; a longer root goes into the table."""


@dataclass(frozen=True)
class GalleryView:
    """Camera and lighting of one picture.

    Positions are in mm, with x mesial, y buccal and z occlusal and the tooth at the origin.
    """

    eye_mm: tuple[float, float, float]
    lamp_mm: tuple[float, float, float]
    lamp_half_mm: float
    """Half width of the lamp, which is square and faces the tooth."""
    lamp_radiance: float
    sky: float
    """Scale factor of the environment's radiance."""
    table: float
    """Reflectance of the table."""
    white: float
    """Radiance that is displayed as white."""
    target_mm: tuple[float, float, float] = (0.0, 0.0, -0.3)
    fov_degrees: float = 22.0


VIEWS = {
    "front": GalleryView((11.0, 45.0, 20.0), (-42.0, 58.0, 30.0), 16.0, 15.0, 0.4, 0.24, 0.75),
    "side": GalleryView((44.0, 15.0, 18.0), (0.0, 66.0, 42.0), 16.0, 15.0, 0.4, 0.24, 0.75),
    "backlit": GalleryView((3.0, 48.0, 12.0), (0.0, -40.0, 34.0), 26.0, 10.0, 0.02, 0.03, 0.95),
    "edge": GalleryView((-14.0, 27.0, 20.0), (46.0, -20.0, 40.0), 16.0, 15.0, 0.3, 0.24, 0.75, (0.0, 0.0, 4.0), 18.0),
}


def procedural_sky(height: int = 32) -> Image:
    """Return an environment (H, 2 H, 3) for scenes without an environment file: bright overhead, warm at the horizon,
    dim below.
    """
    up = np.cos(np.pi * (np.arange(height) + 0.5) / height)[:, None, None]
    zenith, horizon, ground = (
        np.array(colour) for colour in ((0.55, 0.65, 0.80), (0.75, 0.70, 0.64), (0.16, 0.15, 0.14))
    )
    column = np.where(up > 0, horizon + (zenith - horizon) * np.sqrt(np.maximum(up, 0)), ground)
    return np.broadcast_to(column, (height, 2 * height, 3)).copy()


def gallery_scene(view: GalleryView, tooth: Path, environment: Path | None, size_px: tuple[int, int]) -> SceneDict:
    """Return a scene with a table, a lamp and an environment around a tooth, for an RGB variant of Mitsuba.

    Args:
        view: camera and lighting.
        tooth: folder of the tooth's surfaces ``outer.ply`` and, if any, ``dentin.ply``.
        environment: file of the environment; None for the procedural sky.
        size_px: width and height of the picture.

    Raises:
        InputError: the environment's file does not exist.
    """
    import mitsuba as mi

    place = mi.ScalarTransform4f
    if environment is not None and not environment.is_file():
        raise InputError(f"Environment image {environment} does not exist; give an equirectangular EXR or HDR file.")
    picture = (
        {"filename": str(environment)}
        if environment is not None
        else {"bitmap": mi.Bitmap(procedural_sky().astype(np.float32))}
    )
    heights_mm = read_mesh(tooth / "outer.ply").vertices_mm[:, 2]
    table_mm = max(float(heights_mm.min()) - TABLE_GAP_MM, float(heights_mm.max()) - SHOWN_MM)
    scene: SceneDict = {
        "type": "scene",
        "sky": {"type": "envmap", "scale": view.sky, "to_world": place().rotate([1, 0, 0], 90), **picture},
        "lamp": {
            "type": "rectangle",
            "to_world": place().look_at(view.lamp_mm, [0, 0, 0], [0, 0, 1]).scale(view.lamp_half_mm),
            "emitter": {
                "type": "area",
                "radiance": {"type": "rgb", "value": [view.lamp_radiance * c for c in (1.0, 0.96, 0.90)]},
            },
        },
        "table": {
            "type": "rectangle",
            "to_world": place().translate([0, 0, table_mm]).scale([200, 200, 1]),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "rgb", "value": [view.table * c for c in (0.9, 1.0, 1.15)]},
            },
        },
        "enamel": {"type": "ply", "filename": str(tooth / "outer.ply")},
        "camera": {
            "type": "perspective",
            "fov": view.fov_degrees,
            "to_world": place().look_at(view.eye_mm, view.target_mm, [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size_px[0], "height": size_px[1], "pixel_format": "rgb"},
        },
    }
    if (tooth / "dentin.ply").exists():
        scene["dentin"] = {"type": "ply", "filename": str(tooth / "dentin.ply")}
    return scene


def tooth_integrator(enamel: str, dentin: str | None, *, exact: bool) -> SceneDict:
    """Return the integrator for a tooth with the virtual mouth's optics and a glossy surface.

    Args:
        enamel: ids of the shapes that bound the enamel.
        dentin: ids of the shapes that bound the dentin, if any.
        exact: use the media themselves instead of similar ones, which look alike and cost less.
    """
    from services.transport.plugin.integrator import medium_properties

    properties: SceneDict = {"type": "dentine", "boundary": "thin", "roughness": ROUGHNESS}
    for part, ids in (("enamel", enamel), ("dentin", dentin)):
        if ids is not None:
            media = tuple(getattr(tissue, part) for tissue in TRUE_TISSUE.values())
            properties |= {part: ids} | medium_properties(
                part, media if exact else tuple(similar_medium(medium, SIMILAR_G) for medium in media)
            )
    return properties


def tooth_surfaces(outer: Path | None, dentin: Path | None, buccal: Vector3 | None) -> dict[str, Mesh]:
    """Return a tooth's surfaces ``outer`` and, if any, ``dentin``, upright with the crown at the origin; those of the
    procedural incisor where no file is given.

    Args:
        outer: file of the enamel's surface.
        dentin: file of the dentin's surface.
        buccal: direction in the files' coordinates from which the front is seen; None where z is occlusal and y buccal
            already.

    Raises:
        InputError: dentin is given without enamel, or the buccal direction is zero.
        CaptureInputError: a mesh file cannot be read.
        MeshError: a mesh cannot bound a medium.
    """
    if outer is None:
        if dentin is not None:
            raise InputError("A dentin mesh was given without its enamel's outer mesh; give both.")
        incisor = build_incisor(COLUMNS)
        return {"outer": incisor.outer, "dentin": incisor.dentin}
    meshes = {name: read_mesh(path) for name, path in (("outer", outer), ("dentin", dentin)) if path is not None}
    for name, mesh in meshes.items():
        mesh.require_solid(f"{name} surface")
    if buccal is not None:
        if not np.linalg.norm(buccal) > 0:
            raise InputError("The buccal direction is zero; give where the tooth's front looks, such as 0 1 0.")
        middle = meshes["outer"].vertices_mm.mean(axis=0)
        frame = estimate_frame(meshes["outer"], (middle + 1000 * np.asarray(buccal))[None])
        meshes = {name: Mesh(frame.canonical_from_world(mesh.vertices_mm), mesh.faces) for name, mesh in meshes.items()}
    low, high = meshes["outer"].vertices_mm.min(axis=0), meshes["outer"].vertices_mm.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, high[2] - min(SHOWN_MM, high[2] - low[2]) / 2])
    return {name: Mesh(mesh.vertices_mm - origin, mesh.faces) for name, mesh in meshes.items()}


def render(scene: Any, integrator: SceneDict, samples: int, sensor: int = 0, seed: int = 1) -> Image:
    """Render linear radiance (H, W, 3), in passes of ``PASS_SAMPLES`` paths per pixel to limit memory.

    Raises:
        NonFiniteError: a value of the picture is NaN or infinite.
    """
    import mitsuba as mi

    chosen, passes = mi.load_dict(integrator), max(1, samples // PASS_SAMPLES)
    total = np.zeros(())
    for number in range(passes):
        image = np.array(
            mi.render(
                scene, sensor=sensor, integrator=chosen, spp=max(1, samples // passes), seed=1009 * seed + number
            ),
            dtype=np.float64,
        )
        total = total + image[..., :3] / passes
    bad = int(np.count_nonzero(~np.isfinite(total)))
    if bad:
        raise NonFiniteError(f"{bad} values of a picture came out non-finite; report the scene and the media.")
    return total


def table_pictures(options: argparse.Namespace) -> Iterator[tuple[str, Image, float]]:
    """Yield the name, the radiance and the white level of each view of a tooth on a table, with each surface."""
    import mitsuba as mi

    from services.bench.figures.refracting import refracting_picture

    exact = tuple(TRUE_TISSUE.values())
    tissues = exact if options.exact else tuple(similar_tissue(tissue, SIMILAR_G) for tissue in exact)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        surfaces = tooth_surfaces(options.outer, options.dentin, options.buccal)
        for surface, mesh in surfaces.items():
            write_mesh(folder / f"{surface}.ply", mesh)
        integrator = tooth_integrator("enamel", "dentin" if "dentin" in surfaces else None, exact=options.exact)
        for view in options.views:
            scene, white = gallery_scene(VIEWS[view], folder, options.environment, options.size), VIEWS[view].white
            if "thin" in options.surfaces:
                yield view, render(mi.load_dict(scene, optimize=False), integrator, options.samples), white
            if "rough" in options.surfaces:
                samples = max(1, options.samples // ROUGH_DIVISOR)
                yield view + SURFACES["rough"], refracting_picture(scene, tissues, ROUGHNESS, samples), white


def own_pictures(options: argparse.Namespace) -> Iterator[tuple[str, Image, float]]:
    """Yield the name, the radiance and the white level of each sensor of the user's own scene; white is the 99th
    percentile.

    Raises:
        InputError: the scene's file does not exist, or an id names no shape of the scene.
    """
    import mitsuba as mi

    from services.transport.plugin.integrator import read_properties
    from services.transport.plugin.scene_teeth import SceneTeeth

    if not options.scene.is_file():
        raise InputError(f"Scene file {options.scene} does not exist; give a Mitsuba XML scene in millimetres.")
    scene = mi.load_file(str(options.scene), optimize=False)
    integrator = tooth_integrator(options.enamel, options.core, exact=options.exact)
    SceneTeeth(scene, read_properties({k: v for k, v in integrator.items() if k != "type"}, channels=3).shapes)
    for number, sensor in enumerate(scene.sensors()):
        image = render(scene, integrator, options.samples, number)
        yield sensor.id() or f"sensor{number}", image, white_level(image, np.ones(image.shape[:2], dtype=bool))


def main(arguments: list[str] | None = None) -> int:
    """Write the gallery, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m services.bench.figures.gallery", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("--out", type=Path, default=Path("gallery"), help="folder of the pictures (default: gallery)")
    parser.add_argument(
        "--views", nargs="+", choices=tuple(VIEWS), default=tuple(VIEWS), help="which views (default: all)"
    )
    parser.add_argument(
        "--surfaces",
        nargs="+",
        choices=tuple(SURFACES),
        default=tuple(SURFACES),
        help="thin does not refract, rough is a rough dielectric; not with --scene (default: both)",
    )
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel, an eighth for rough (default: 256)")
    parser.add_argument(
        "--size", type=int, nargs=2, metavar=("W", "H"), default=SIZE_PX, help="pixels (default: 320 400)"
    )
    parser.add_argument(
        "--exact",
        action="store_true",
        help="the media themselves, not similar ones of lower mean cosine: slower, noisier, hardly different",
    )
    parser.add_argument(
        "--outer", type=Path, help="another tooth's enamel surface, mm; z occlusal and y buccal, or give --buccal"
    )
    parser.add_argument("--dentin", type=Path, help="its dentin surface")
    parser.add_argument(
        "--buccal",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="where its front looks; the tooth is then turned upright",
    )
    parser.add_argument("--environment", type=Path, help="equirectangular EXR or HDR image instead of a plain sky")
    parser.add_argument("--scene", type=Path, help="your own Mitsuba XML scene, mm")
    parser.add_argument(
        "--enamel", default="enamel", help="with --scene: ids of the shapes around enamel, comma separated"
    )
    parser.add_argument("--core", help="with --scene: ids of the shapes around dentin")
    parser.add_argument("--variant", choices=("llvm", "cuda"), default="llvm", help="where to render (default: llvm)")
    options = parser.parse_args(arguments)
    try:
        if options.samples < 1 or min(options.size) < 1:
            raise InputError("A picture needs at least one sample and one pixel; raise --samples or --size.")
        prepare_device(backend=options.variant, colours="rgb")
        from services.transport.plugin.integrator import register_integrator

        register_integrator()
        options.out.mkdir(parents=True, exist_ok=True)
        drawn = {}
        for name, image, white in own_pictures(options) if options.scene is not None else table_pictures(options):
            drawn[name] = tone_map(image, white)
            path = options.out / f"{name}.png"
            write_atomic(path, png_bytes(drawn[name]))
            print(path, flush=True)
        if options.scene is None:
            shown = [name for name in SURFACES if name in options.surfaces]
            rows = [[drawn[view + SURFACES[name]] for view in options.views] for name in shown]
            path = options.out / "gallery.png"
            write_atomic(path, png_bytes(mosaic(rows, [Column(view) for view in options.views], shown, scale=1)))
            print(path, flush=True)
    except DentineError as problem:
        print(f"gallery: {problem.message}", file=sys.stderr)
        return problem.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main())
