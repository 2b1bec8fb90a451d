"""Render the measured tooth with Mitsuba 3: ``python render.py --camera c0 --light l0 --spp 256 --out tooth.exr``.

Each colour channel is its own scene, because scattering differs per channel and Mitsuba's phase functions hold one
number. The image has the photographs' pixels; ``--large`` writes the film's, which are at least 512 on an edge.
``--colour srgb`` or ``acescg`` develops the camera's red, green and blue by the calibration's root polynomial or
matrix, with 1 for a white diffuser that faces the light. A file name that ends with .png gives a picture in sRGB.
"""

import argparse
import json
import runpy
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

DEPTHS = {"max_depth": 5000, "rr_depth": 100}
"""Limits of an integrator that takes the place of the scenes' own, whose limits these are."""


def render(
    folder: Path,
    camera: str,
    light: str,
    spp: int,
    seed: int = 0,
    variant: str = "llvm_ad_mono",
    large: bool = False,
    integrator: str = "",
) -> np.ndarray:
    """Linear radiance (H, W, C) of one camera under one light, from so many paths per pixel of the result.

    Args:
        integrator: in place of the scenes' own; ``prbvolpath`` takes 2.7 times as long and has no bright specks.
    """
    if mi.variant() != variant:
        mi.set_variant(variant)
    rig = json.loads((folder / "rig.json").read_text())
    if rig["boundary"] == "thin":
        runpy.run_path(str(folder / "thin_boundary.py"))["register"]()
    sensor = rig["cameras"].index(camera)
    width, height = rig["views"][camera]["size"]
    film = {} if large else {f"width_{sensor}": width, f"height_{sensor}": height}
    x, y, z = rig["lights"][light]["position_mm"]
    planes = []
    for channel, intensity in zip(rig["channels"], rig["lights"][light]["intensity"], strict=True):
        given = {"light_x": x, "light_y": y, "light_z": z, "intensity": intensity} | film
        scene = mi.load_file(str(folder / f"scene_{channel}.xml"), optimize=False, **given)
        chosen = mi.load_dict({"type": integrator, **DEPTHS}) if integrator else scene.integrator()
        planes.append(np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed, integrator=chosen))[..., 0])
    return np.stack(planes, axis=-1)


SPACES = {"srgb": "linear sRGB", "acescg": "ACEScg"}


def develop(image: np.ndarray, folder: Path, camera: str, light: str, colour: str) -> np.ndarray:
    """Linear colours (..., 3) of radiance (..., C) that ``render`` has returned, 1 for a white diffuser in that light.

    Args:
        colour: ``srgb`` or ``acescg``; ``rig.json`` says where a camera's colours come from.
    """
    rig = json.loads((folder / "rig.json").read_text())
    told, lamp = rig["colour"], rig["lights"][light]
    distance = np.linalg.norm(np.subtract(lamp["position_mm"], told["diffuser_mm"]))
    relative = image * np.pi * distance**2 / np.array(lamp["intensity"])
    rgb = relative[..., [rig["channels"].index(name) for name in told["channels"]]]
    own = told["cameras"][camera]
    if own["root_polynomial"] is None:
        xyz = rgb @ np.array(own["xyz_d50_from_rgb"]).T
    else:  # Finlayson, Mackiewicz & Hurlbert 2015
        red, green, blue = np.moveaxis(np.maximum(rgb, 0), -1, 0)
        terms = [red, green, blue, np.sqrt(red * green), np.sqrt(green * blue), np.sqrt(red * blue)]
        xyz = np.stack(terms, axis=-1) @ np.array(own["root_polynomial"]).T
    return np.asarray(xyz @ np.array(told["from_xyz"][SPACES[colour]]).T)


def write_image(image: np.ndarray, path: Path) -> None:
    """Write linear values, shape (height, width, channels), as EXR, or as a PNG in sRGB."""
    if dr.thread_count() < 2:
        dr.set_thread_count(2)  # Mitsuba's writer waits for another thread, for ever where there is none
    bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
    if path.suffix == ".png":
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    bitmap.write(str(path))


def main() -> None:
    """Read the command line, render, write an image."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--camera", default=None, help="name in rig.json; default the first")
    parser.add_argument("--light", default=None, help="name in rig.json; default the first")
    parser.add_argument("--spp", type=int, default=256, help="paths per pixel")
    parser.add_argument("--large", action="store_true", help="write the film's pixels and not the photographs'")
    parser.add_argument("--colour", choices=["camera", *SPACES], help="default camera, in a PNG srgb")
    parser.add_argument("--out", type=Path, default=Path("tooth.exr"), help="EXR file, or PNG")
    options = parser.parse_args()
    folder = Path(__file__).resolve().parent
    rig = json.loads((folder / "rig.json").read_text())
    camera, light = options.camera or rig["cameras"][0], options.light or next(iter(rig["lights"]))
    colour = options.colour or ("srgb" if options.out.suffix == ".png" else "camera")
    if colour != "camera" and "colour" not in rig:
        parser.error(
            "this asset has no red, green and blue; choose --colour camera and a file name that ends with .exr"
        )
    image = render(folder, camera, light, options.spp, large=options.large)
    if colour != "camera":
        image = develop(image, folder, camera, light, colour)
    write_image(image, options.out)


if __name__ == "__main__":
    main()
