"""False and missed motions where motion is judged by the outline of a tooth: images of stock Mitsuba.

python -m tests.benchmarks.outline_motion --folder outline-motion --json outline_motion.json

Opaque, rough, glossy teeth of several subjects are rendered at 600 x 700 pixels under the lights of a dome and binned
to smaller sizes. In static stacks nothing moves; in moved ones the tooth has another place under every light but the
first, by a rigid translation across the mean line of sight, so that cameras see about the stated number of pixels of
each size. ``--translucent`` judges static translucent teeth instead: those of ``tests/data/truths``, or files that
``render_truths --pixel-mm`` made. Renders are kept in the folder; they take 15 minutes of a core, and the rest five.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.anatomy.templates.jaw import build_jaw
from services.core.geometry import Camera, Light, Mesh
from services.core.store import write_atomic
from services.phantom.dome_rig import dome_cameras, dome_lights
from services.preprocess.stabilisation.motion import MIN_REACH_PX
from services.preprocess.stabilisation.null_hypothesis import decided
from services.preprocess.stabilisation.outline import OutlineMatcher
from services.preprocess.views.projection import project
from tests.benchmarks.render_truths import CASES
from tests.support.truths import read

Array = NDArray[np.float64]

SUBJECTS: Mapping[str, tuple[int, int]] = {"incisor": (11, 11), "canine": (12, 23), "premolar": (13, 14)}
"""Seed of the jaw and FDI number of each opaque tooth; none of them set a constant of the method."""
SIZE, LIGHTS, CAMERAS, STACKS, MOVED_STACKS = (600, 700), 9, 3, 6, 2
"""Largest size of an image, lights of a stack, cameras, and static and moved stacks of each subject. Each stack has
lights of its own."""
FILLED = 0.86
"""Share of the image that the tooth fills."""
SAMPLES = 9
BINS = (1, 4, 10, 20)
MOVES_PX = (0.0, 0.3, 1.0, 3.0)
LIMIT_OF_REACH = 5 / 24
"""Search reach as a share of the tooth's shorter side, as in a preparation."""
STANDARD_ERRORS = 1.96
"""Standard errors of a 95 % bound of a rate."""


@dataclass(frozen=True)
class Stack:
    """Images of one tooth in one camera.

    Attributes:
        images: (L, H, W).
        places_mm: (L, 3) translations of the tooth.
    """

    mesh: Mesh
    camera: Camera
    lights: tuple[Light, ...]
    images: NDArray[np.float32]
    places_mm: Array

    def binned(self, factor: int) -> Stack:
        """The same images with larger pixels."""
        width, height = (length // factor for length in self.camera.size)
        cut = self.images[:, : height * factor, : width * factor]
        images = cut.reshape(len(cut), height, factor, width, factor).mean(axis=(2, 4))
        K = np.array(self.camera.K)
        K[:2] /= factor
        camera = self.camera.model_copy(update={"size": (width, height), "K": tuple(map(tuple, K.tolist()))})
        return Stack(self.mesh, camera, self.lights, images, self.places_mm)

    def true_px(self) -> Array:
        """Displacements (L, 2) of the tooth's centre since the first image."""
        centre = self.mesh.vertices_mm.mean(axis=0)
        image, _ = self.camera.project(centre + self.places_mm)
        return np.asarray(image - image[0])

    def found_px(self) -> tuple[Array, Array]:
        """Displacements (L, 2) that a preparation takes out, and their standard errors (L,)."""
        footprint = project(self.camera, [self.mesh])
        visible = footprint.mesh == 0
        sides = [int(np.ptp(np.flatnonzero(visible.any(axis=axis)))) + 1 for axis in (0, 1)]
        matcher = OutlineMatcher(
            self.camera,
            [0],
            visible,
            max(LIMIT_OF_REACH * min(sides), MIN_REACH_PX),
            lambda seen: project(seen, [self.mesh]),
        )
        found = [matcher.match(image, light.position_mm) for image, light in zip(self.images, self.lights, strict=True)]
        return decided(
            np.array([one.shift_px for one in found]),
            np.array([one.error_px for one in found]),
            np.array([one.arcs_px for one in found]),
        )

    def height_px(self) -> float:
        """Longer side of the tooth."""
        image, _ = self.camera.project(self.mesh.vertices_mm)
        return float(np.ptp(image, axis=0).max())


def main() -> None:
    """Render what is missing, judge all stacks, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="keeps the renders")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--moves", type=float, nargs="*", default=MOVES_PX, help="pixels")
    parser.add_argument("--bins", type=int, nargs="*", default=BINS)
    parser.add_argument("--translucent", type=Path, nargs="*", help="files as tests/data/truths has them")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    if options.translucent is not None:
        for stacks in _translucent(options.translucent):
            rows += [_row(f"translucent, {name}", 0.0, own) for name, own in stacks.items()]
    else:
        for factor in options.bins:
            for move_px in options.moves:
                stacks_of_size = list(_opaque(options.folder, factor, move_px))
                rows.append(_row(f"opaque, pixels of {factor}", move_px, stacks_of_size))
                print(rows[-1], flush=True)
                write_atomic(options.json, json.dumps(rows, indent=1).encode())
    write_atomic(options.json, json.dumps(rows, indent=1).encode())


def _row(name: str, move_px: float, stacks: Sequence[Stack]) -> dict[str, Any]:
    errors, found, stated = list[Array](), list[Array](), list[Array]()
    for stack in stacks:
        shift, error = stack.found_px()
        # The first image is the reference, and no image under test
        errors.append((shift - stack.true_px())[1:])
        found.append(shift[1:])
        stated.append(error[1:])
    error, shift, standard = np.concatenate(errors), np.concatenate(found), np.concatenate(stated)
    moved = np.linalg.norm(shift, axis=-1) > 0
    number = len(moved)
    told = int(moved.sum())
    wrong = told if move_px == 0 else number - told
    row: dict[str, Any] = {
        "stacks": name,
        "height_px": round(float(np.median([stack.height_px() for stack in stacks])), 1),
        "move_px": move_px,
        "images": number,
        "false" if move_px == 0 else "missed": wrong,
        "upper bound, %": round(100 * _upper_bound(wrong, number), 2),
        "rms error of a component, px": round(float(np.sqrt((error**2).mean())), 3),
        "error in standard errors, rms": round(float(np.sqrt(((error / standard[:, None]) ** 2).mean())), 2),
        "median standard error, px": round(float(np.median(standard)), 3),
    }
    if moved.any() and move_px > 0:
        row["rms error of a component where moved, px"] = round(float(np.sqrt((error[moved] ** 2).mean())), 3)
    return row


def _upper_bound(count: int, number: int) -> float:
    """Upper end of Wilson's 95 % interval of a rate; three in ``number`` where none was seen (Hanley 1983)."""
    if count == 0:
        return 3 / number
    z, share = STANDARD_ERRORS, count / number
    middle = share + z * z / (2 * number)
    reach = z * np.sqrt(share * (1 - share) / number + z * z / (4 * number * number))
    return float((middle + reach) / (1 + z * z / number))


def _opaque(folder: Path, factor: int, move_px: float) -> Iterator[Stack]:
    """Stacks whose tooth moves by ``move_px`` of the pixels that are ``factor`` of the largest size's wide."""
    for name in SUBJECTS:
        for number in range(MOVED_STACKS if move_px else STACKS):
            stack = _rendered(folder, name, number, factor * move_px)
            yield from (one.binned(factor) for one in stack)


def _rendered(folder: Path, name: str, number: int, move_px: float) -> list[Stack]:
    """One stack in every camera; it is rendered once. All moves share the lights."""
    seed, fdi = SUBJECTS[name]
    tooth = build_jaw(seed).tooth(fdi)
    mesh = Mesh(tooth.frame.canonical_from_world(tooth.outer.vertices_mm), tooth.outer.faces)
    random = np.random.default_rng([seed, number])
    cameras = [_framed(camera, mesh) for camera in dome_cameras(CAMERAS, 0.5, (mesh,))]
    lights = dome_lights(LIGHTS * STACKS, ("green",), seed)[number::STACKS][:LIGHTS]
    sight = np.mean([np.array(camera.camera_from_world)[2, :3] for camera in cameras], axis=0)
    turned = random.normal(size=(len(lights), 3))
    turned -= np.outer(turned @ sight, sight) / (sight @ sight)
    depth_mm = cameras[0].project(mesh.vertices_mm)[1].mean()
    places = turned / np.linalg.norm(turned, axis=-1, keepdims=True) * move_px * depth_mm / cameras[0].K[0][0]
    places[0] = 0
    stored = folder / f"{name}-{number}-{move_px:g}.npy"
    if not stored.exists():
        images = [
            [_image(mesh.vertices_mm + place, mesh.faces, camera, light, 1000 * number + 10 * k + c)
             for k, (place, light) in enumerate(zip(places, lights, strict=True))]
            for c, camera in enumerate(cameras)
        ]  # fmt: skip
        np.save(stored, np.array(images, dtype=np.float16))
    images_of = np.load(stored).astype(np.float32)
    return [Stack(mesh, camera, tuple(lights), own, places) for camera, own in zip(cameras, images_of, strict=True)]


def _framed(camera: Camera, mesh: Mesh) -> Camera:
    """The camera with a lens and a place from which the tooth fills an image of the largest size."""
    width, height = SIZE
    pose = np.array(camera.camera_from_world)
    seen = mesh.vertices_mm @ pose[:3, :3].T + pose[:3, 3]
    slope = seen[:, :2] / seen[:, 2:]
    focal_px = float(FILLED * min(width / np.ptp(slope[:, 0]), height / np.ptp(slope[:, 1])))
    pose[:2, 3] -= 0.5 * (slope.max(axis=0) + slope.min(axis=0)) * seen[:, 2].mean()
    K = ((focal_px, 0.0, width / 2), (0.0, focal_px, height / 2), (0.0, 0.0, 1.0))
    return camera.model_copy(update={"size": SIZE, "K": K, "camera_from_world": tuple(map(tuple, pose.tolist()))})


def _image(vertices_mm: Array, faces: NDArray[np.int32], camera: Camera, light: Light, seed: int) -> Array:
    """Stock Mitsuba's direct light on a rough, glossy, opaque surface; the brightest value is one."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_mono")
    mesh = mi.Mesh("tooth", len(vertices_mm), len(faces), props=_bsdf(mi), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(vertices_mm.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    parameters.update()
    mesh.recompute_vertex_normals()
    (width, height), focal_px = camera.size, camera.K[0][0]
    world_from_camera = np.linalg.inv(np.array(camera.camera_from_world)) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    sensor = {
        "type": "perspective",
        "fov": float(2 * np.degrees(np.arctan(width / (2 * focal_px)))),
        "fov_axis": "x",
        "near_clip": 10.0,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(world_from_camera),
        "film": {
            "type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": SAMPLES},
    }  # fmt: skip
    lamp = {"type": "point", "position": list(light.position_mm), "intensity": 1e6}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": sensor,
            "tooth": mesh,
            "light": lamp,
        },
        optimize=False,
    )
    image = np.array(mi.render(scene, spp=SAMPLES, seed=seed))[..., 0].astype(float)
    return np.asarray(image / image.max())


def _bsdf(mi: Any) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "roughplastic", "alpha": 0.25, "diffuse_reflectance": 0.6})
    return properties


def _translucent(files: Sequence[Path]) -> Iterator[dict[str, list[Stack]]]:
    for name in files or [Path(case) for case in CASES]:
        truth = read(name.stem, name.parent) if name.suffix else read(name.name)
        lights = tuple(Light.model_validate(light) for light in truth.description["lights"])
        cameras = [Camera.model_validate(camera) for camera in truth.description["cameras"]]
        yield {
            name.stem: [
                Stack(
                    truth.meshes["outer"],
                    camera,
                    lights,
                    truth.mean[camera.name].astype(np.float32),
                    np.zeros((len(lights), 3)),
                )
                for camera in cameras
            ]
        }


if __name__ == "__main__":
    main()
