"""Build the measured teeth as a scene of Blender 5 (Cycles): media, surfaces, cameras, lights and settings.

Three ways to run it in the folder of an asset::

    blender --python blender_scene.py                       opens Blender with the scene; options stand after --
    Scripting > Open > blender_scene.py > Run Script        the same inside Blender
    python blender_scene.py --render tooth.exr --camera c0 --light l0 --samples 256
    python blender_scene.py --save tooth.blend              these two need the module bpy: pip install bpy==5.0.1

Cycles scatters light in the media themselves, so its pictures are those of the measured parameters. It adds the
coefficients of volumes that overlap. Therefore the enamel is a shell, of the outer surface and the dentin's surface
turned round, and the dentin's own object lies ``GAP_MM`` inside that: of two faces at the same place one is passed
over, which changed the light of balls and of an incisor by 4 to 52 %.
"""

from __future__ import annotations

import argparse
import math
import runpy
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

try:
    import bpy
    from mathutils import Matrix
except ImportError:
    sys.exit("This script runs inside Blender 5, or in Python 3.11 after: pip install bpy==5.0.1")


def here() -> Path:
    """The folder of this script's file; in the text editor ``__file__`` is a text's name only."""
    path = Path(__file__)
    text = None if path.is_file() else bpy.data.texts.get(path.name)
    return (path if text is None else Path(bpy.path.abspath(text.filepath))).resolve().parent


HERE = here()
bodies, materials = (SimpleNamespace(**runpy.run_path(str(HERE / f"{name}.py"))) for name in ("bodies", "materials"))

GAP_MM = 1e-4
"""Distance between the surfaces of two bodies that touch, mm. A gap of 0.01 mm costs 0.3 % of the light; single
precision resolves 1e-6 mm of a tooth."""
BOUNCES = 1024
"""Largest number of scattering events of a path. Enamel scatters light hundreds of times: 12 bounces, Blender's usual
number, give 71 % of the light."""
MIN_PIXELS = 512
"""Least number of pixels of a picture's longer side, unless ``--scale`` is given."""
UNITS = {"mm": 1.0, "m": 0.001}
"""Blender units per mm, by the name of the length that one Blender unit stands for."""
MARK = "measured_asset"
"""Custom property of the scenes that this script made: the asset's folder."""


def add_body(scene: Any, body: Any, unit: float, look: Any) -> None:
    """An object of one body; its faces carry the numbers ``ior`` and ``outside`` of their side."""
    surface = body.surface()
    if body.moved:
        surface = surface.moved_inwards(GAP_MM)
    mesh = bpy.data.meshes.new(body.name)
    mesh.from_pydata(surface.vertices * unit, [], surface.faces)
    for name in ("ior", "outside"):
        values = np.concatenate([np.full(len(side.surface.faces), getattr(side, name)) for side in body.sides])
        mesh.attributes.new(name, "FLOAT", "FACE").data.foreach_set("value", values.astype(np.float32))
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", surface.corners_uv.astype(np.float32).reshape(-1))
    mesh.polygons.foreach_set("use_smooth", np.full(len(surface.faces), look.smooth))
    material = bpy.data.materials.new(body.name)
    materials.fill(material, body, look, unit)
    mesh.materials.append(material)
    thing = bpy.data.objects.new(body.name, mesh)
    for name in ("sigma", "alpha", "beta", "g1", "g2"):
        thing[f"{name}_per_mm" if name == "sigma" else name] = getattr(body.medium, name).tolist()
    thing["absorption_factor"] = look.absorption
    scene.collection.objects.link(thing)


def add_wall(scene: Any, asset: Any, unit: float) -> None:
    """The diffuse wall behind the teeth of a mouth, where it has one."""
    path = asset.folder / "cavity.ply"
    if not path.is_file():
        return
    surface, mesh = bodies.read_ply(path), bpy.data.meshes.new("cavity")
    mesh.from_pydata(surface.vertices * unit, [], surface.faces)
    material = bpy.data.materials.new("cavity")
    nodes = materials.Nodes(material)
    shader = nodes.add("ShaderNodeBsdfDiffuse", {"Color": (*asset.values("cavity.reflectance", 0.0), 1.0)})
    nodes.add("ShaderNodeOutputMaterial", {"Surface": shader})
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("cavity", mesh))


def add_camera(scene: Any, name: str, view: Mapping[str, Any], unit: float) -> None:
    """A pinhole camera; Blender looks along -z with y upwards, the asset's cameras along z with y downwards."""
    (width, height), intrinsic = view["size"], np.array(view["K"])
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = data.sensor_width * intrinsic[0, 0] / width
    data.shift_x, data.shift_y = 0.5 - intrinsic[0, 2] / width, (intrinsic[1, 2] - height / 2) / width
    pose = np.linalg.inv(np.array(view["camera_from_world"])) @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] *= unit
    distance = float(np.linalg.norm(pose[:3, 3]))
    data.clip_start, data.clip_end = 1e-3 * distance, 10 * distance
    thing = bpy.data.objects.new(name, data)
    thing.matrix_world = Matrix(pose.tolist())
    thing["size"] = [int(width), int(height)]
    scene.collection.objects.link(thing)


def add_lamp(scene: Any, name: str, position_mm: Sequence[float], intensity: np.ndarray, unit: float) -> None:
    """A point light of a radiant intensity (3,) with mm as the length unit."""
    data, largest = bpy.data.lights.new(name, "POINT"), float(intensity.max())
    data.energy, data.color = 4 * math.pi * largest * unit**2, intensity / max(largest, 1e-30)
    data.shadow_soft_size, data.use_soft_falloff = 0.0, False
    thing = bpy.data.objects.new(name, data)
    thing.location = np.array(position_mm) * unit
    scene.collection.objects.link(thing)


def set_world(scene: Any, sky: float, environment: Path | None) -> None:
    """Light from all directions: a uniform radiance, or a picture of the environment times that."""
    scene.world = bpy.data.worlds.new(scene.name)
    nodes = materials.Nodes(scene.world)
    inputs: dict[str | int, Any] = {"Color": (1.0, 1.0, 1.0, 1.0), "Strength": sky}
    if environment is not None:
        if not environment.is_file():
            raise bodies.SceneError(f"{environment} is no file; name a picture of an environment, HDR or EXR.")
        image = bpy.data.images.load(str(environment))
        inputs["Color"] = nodes.add("ShaderNodeTexEnvironment", image=image)
    nodes.add("ShaderNodeOutputWorld", {"Surface": nodes.add("ShaderNodeBackground", inputs)})


def set_up_cycles(scene: Any, samples: int, seed: int) -> None:
    """Settings with which Cycles leaves out no light and changes no pixel afterwards."""
    scene.render.engine = "CYCLES"
    settings = {
        "samples": samples,
        "seed": seed,
        "sample_clamp_direct": 0.0,
        "sample_clamp_indirect": 0.0,
        "blur_glossy": 0.0,
        "light_sampling_threshold": 0.0,
        "use_denoising": False,
        "use_adaptive_sampling": False,
        "use_fast_gi": False,
        "use_guiding": False,
        "pixel_filter_type": "BOX",
        "caustics_reflective": True,
        "caustics_refractive": True,
    }
    kinds = ("max", "volume", "diffuse", "glossy", "transmission", "transparent_max")
    for name, value in (settings | {f"{kind}_bounces": BOUNCES for kind in kinds}).items():
        setattr(scene.cycles, name, value)
    # A picture of 8 bits then has the curve of sRGB and no other.
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_percentage = 100


def new_scene(folder: Path) -> Any:
    """An empty scene; an earlier one of the same asset is taken away, and a user's own scenes stay."""
    earlier = [scene for scene in bpy.data.scenes if scene.get(MARK) == str(folder)]
    scene = bpy.data.scenes.new("teeth")
    for old in earlier if started_in_blender() else [each for each in bpy.data.scenes if each != scene]:
        things = list(old.objects)
        materials_of = [material for thing in things if thing.type == "MESH" for material in thing.data.materials]
        bpy.data.batch_remove({*things, *(thing.data for thing in things if thing.data), *materials_of})
        bpy.data.scenes.remove(old)
    scene.name = "teeth"
    return scene


def started_in_blender() -> bool:
    """Whether Blender, or its text editor, runs this script, and not Python with Blender as a module."""
    return not (bpy.app.module and Path(sys.argv[0]).name == Path(__file__).name)


def build(asset: Any, options: argparse.Namespace) -> Any:
    """Build the asset's scene and return it."""
    scene = new_scene(asset.folder)
    scene[MARK], unit = str(asset.folder), UNITS[options.unit]
    units = scene.unit_settings
    units.system, units.scale_length, units.length_unit = "METRIC", 0.001 / unit, "MILLIMETERS"
    finish = asset.finish(options.surface, options.roughness)
    absorption = bodies.THIN_ABSORPTION if asset.as_glass(options.surface) else 1.0
    look = materials.Look(*finish, absorption, options.highlight, not options.flat, options.subsurface)
    for body in asset.solids() if look.subsurface else asset.bodies():
        add_body(scene, body, unit, look)
    add_wall(scene, asset, unit)
    for name, view in asset.rig["views"].items():
        add_camera(scene, name, view, unit)
    for name, light in asset.rig["lights"].items():
        add_lamp(scene, name, light["position_mm"], asset.intensity(name), unit)
    set_world(scene, options.sky, options.environment)
    set_up_cycles(scene, options.samples, options.seed)
    if options.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", options.threads
    choose(scene, asset, options)
    text = bpy.data.texts.new("notes on the teeth")
    text.write("\n".join(notes(asset, look)) + "\n")
    return scene


def choose(scene: Any, asset: Any, options: argparse.Namespace) -> None:
    """Set the camera and its picture's size, and leave one lamp on: each photograph was lit by one."""
    cameras, lights = asset.rig["cameras"], list(asset.rig["lights"])
    camera, light = options.camera or cameras[0], options.light or lights[0]
    for name, known in ((camera, cameras), (light, [*lights, "none"])):
        if name not in known:
            raise bodies.SceneError(f"The asset knows no {name}; choose from {', '.join(known)}.")
    scene.camera = scene.objects[camera]
    for name in lights:
        scene.objects[name].hide_render = scene.objects[name].hide_viewport = name != light
    size = scene.camera["size"]
    scale = options.scale or max(1, math.ceil(MIN_PIXELS / max(size)))
    scene.render.resolution_x, scene.render.resolution_y = (round(scale * length) for length in size)


def notes(asset: Any, look: Any) -> list[str]:
    """Sentences on what the scene shows of the asset, and what it does not."""
    told = [f"Red, green and blue show the channels {', '.join(asset.channels)}."]
    if asset.as_glass(look.surface) and not look.subsurface:
        told.append(
            f"The fit's thin boundary lets light pass straight on; this surface of glass refracts it. Therefore the"
            f" media have {look.absorption} times the absorption that was fitted, and stains are left out. Under a sky"
            " an incisor is then 1 % darker to 2 % brighter than with the thin boundary (median ΔE00 0.9 to 1.1); with"
            " the absorption that was fitted it would be 14 to 28 % darker. Under a lamp it is up to 22 % darker from"
            " the front and 24 % brighter from behind, by stock Mitsuba. A lamp without size does not shine through"
            " glass: use --sky."
        )
    if asset.rig["boundary"] == "rough" and look.surface == "glass":
        told.append(
            "Cycles' facets hide each other less than those of the fit: light out of the tooth is 0.6, 8 and 29 % too"
            " bright under a lamp at a GGX alpha of 0.1, 0.3 and 0.6; under a sky 0.8 % at 0.3."
        )
    if look.subsurface:
        told.append("Front light, distant shots: subsurface scattering with the dentin's values stands for the media.")
    if not asset.one_phase and not look.subsurface:
        told.append(
            "Scattering has another mean cosine in each channel, which makes pictures of all channels at once noisy;"
            " --render takes the channels one after another."
        )
    return told


def render(asset: Any, options: argparse.Namespace) -> None:
    """Render a picture: linear radiance where it is EXR, else with the curve of sRGB.

    Where a mean cosine differs by channel, each channel has a render of its own.
    """
    if asset.one_phase or options.subsurface:
        render_scene(build(asset, options), options.render)
        return
    planes = []
    with tempfile.TemporaryDirectory() as folder:
        for channel in asset.channels:
            grey = type(asset)(asset.folder, [channel])
            scene = build(grey, options)
            render_scene(scene, Path(folder) / f"{channel}.exr")
            picture = bpy.data.images.load(str(Path(folder) / f"{channel}.exr"))
            picture.colorspace_settings.name = "Non-Color"
            planes.append(np.array(picture.pixels[:]).reshape(-1, 4)[:, :1])
    width, height = picture.size
    joined = bpy.data.images.new("teeth", width, height, float_buffer=True)
    joined.pixels.foreach_set(np.concatenate([*planes, np.ones_like(planes[0])], axis=1).astype(np.float32).reshape(-1))
    picture_format(scene, options.render)
    joined.save_render(str(options.render.resolve()), scene=scene)


def picture_format(scene: Any, path: Path) -> None:
    """Set the format that a file's name asks for."""
    exr = path.suffix.lower() == ".exr"
    scene.render.image_settings.file_format = "OPEN_EXR" if exr else "PNG"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32" if exr else "8"


def render_scene(scene: Any, path: Path) -> None:
    """Render one scene into a file."""
    picture_format(scene, path)
    scene.render.filepath = str(path.resolve())
    bpy.ops.render.render(write_still=True, scene=scene.name)


def parser() -> argparse.ArgumentParser:
    """The options; those about pictures count when there is one to make."""
    found = argparse.ArgumentParser(prog="blender_scene.py", description=(__doc__ or "").splitlines()[0])
    found.add_argument("--asset", type=Path, help="the asset's folder; default the script's own")
    found.add_argument("--render", type=Path, help="write this picture, .exr for radiance or .png")
    found.add_argument("--save", type=Path, help="write this .blend file")
    found.add_argument("--camera", help="name in rig.json; default the first")
    found.add_argument("--light", help="name in rig.json, or none; default the first")
    found.add_argument("--sky", type=float, default=0.0, help="radiance from all directions")
    found.add_argument("--environment", type=Path, help="HDR or EXR picture of an environment, times --sky")
    found.add_argument("--channels", nargs="+", default=[], help="the channels shown as red, green, blue")
    found.add_argument("--samples", type=int, default=256, help="paths per pixel")
    found.add_argument("--seed", type=int, default=0)
    found.add_argument("--scale", type=float, help="pixels per pixel of the photograph; default at least 512 pixels")
    found.add_argument("--unit", choices=tuple(UNITS), default="mm", help="what one Blender unit is")
    found.add_argument("--surface", choices=("asset", "glass"), default="asset", help="the fit's boundary, or glass")
    found.add_argument("--roughness", type=float, help="of a boundary that reflects; default the asset's, else 0")
    found.add_argument("--highlight", type=float, help="add a GGX highlight of this roughness")
    found.add_argument("--flat", action="store_true", help="flat faces, as in the fit")
    found.add_argument("--subsurface", action="store_true", help="no media: for front light and distant shots")
    found.add_argument("--threads", type=int, help="processor threads; default all")
    return found


def arguments() -> list[str]:
    """The words that are meant for this script: inside Blender those after ``--``."""
    if not started_in_blender():
        return sys.argv[1:]
    return sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []


def asset_folder() -> Path:
    """The folder of the asset in which the script or the .blend file lies."""
    for place in (HERE, Path(bpy.data.filepath).resolve().parent):
        for folder in (place, *place.parents):
            if (folder / "rig.json").is_file() and (folder / "parameters.json").is_file():
                return folder
    raise bodies.SceneError(
        "No asset lies around this script; open it from an asset's folder, or name one with --asset."
    )


def main() -> None:
    """Build the scene, and render or save it where asked."""
    options = parser().parse_args(arguments())
    try:
        asset = bodies.Asset((options.asset or asset_folder()).resolve(), options.channels)
        if options.render:
            render(asset, options)
        if options.save or not options.render:
            scene = build(asset, options)
            if bpy.context.window:
                bpy.context.window.scene = scene
        if options.save:
            bpy.ops.wm.save_as_mainfile(filepath=str(options.save.resolve()))
    except RuntimeError as problem:
        if started_in_blender():
            raise
        sys.exit(str(problem))


if __name__ == "__main__":
    main()
