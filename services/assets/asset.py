"""The exported asset: a folder that stock Mitsuba renders, with the measured parameters beside the scenes.

::

    scene_<channel>.xml        one scene per colour channel; light and its intensity are parameters of the file
    scene.xml                  for ``mitsuba scene.xml``: of red, green and blue in one where the channels have these
                               names, else the first channel's; not for the boundary model ``thin``
    scene_dielectric.xml       of the boundary model ``thin`` in its place: rough dielectrics under an even sky
    teeth/<FDI>/*.ply          enamel's outer surface and dentin, mm
    gums.ply, cavity.ply       of a jaw
    surfaces/*.ply             of a jaw: its surfaces cut along each other, as the scenes need them
    teeth/<FDI>/stain_*        per channel, where stains were fitted: a_t as .npy, and 1 - a_t as .png, on the outer
                               surface's u, v
    scene_srgb.xml             of a tooth without stains, boundary ``matched``: its media in linear sRGB, a white light
    scene_spectral.xml         the same as upsampled spectra under daylight D65
    colour.json                media in linear sRGB, in ACEScg and as spectra
    rig.json                   cameras, lights and channels by name; colours of the cameras; the surface
    parameters.json            per channel: value, se, unit, determined; a jaw's teeth carry their number,
                               ``11.enamel.sigma``
    errors.json                fitted and held-out image error, whether the fit converged, correlations, which
                               quantities the capture determines; for a jaw's teeth too
    provenance.json            what it was made from; ``services.core.provenance.record`` says in which form
    render_beside_photograph.png, colour_differences.json
                               photographs beside renders, and their differences, of a tooth or object in red, green
                               and blue
    NOT-CONVERGED.txt          only where the fit did not converge: advice on what to do
    render.py                  renders the scenes
    thin_boundary.py           surface model that Mitsuba lacks, only for the boundary model ``thin``
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from services.assets.colour.develop import CapturedColours, rig_colours
from services.assets.colour.tables import colour_tables, coloured_media
from services.assets.content import RGB
from services.assets.mitsuba.coloured import spectral_scene, srgb_scene
from services.assets.mitsuba.dielectric import DIELECTRIC_SCENE, as_dielectric
from services.assets.mitsuba.mouth_scene import mouth_scene, write_mouth_surfaces
from services.assets.mitsuba.rgb import colour_scene
from services.assets.mitsuba.scene import (
    SceneDict,
    large_film,
    nested_scene,
    sensor_dict,
    shell_integrator,
    with_square_pixels,
)
from services.assets.mitsuba.scene_xml import SceneParameter, write_scene
from services.assets.stains import write_textures
from services.core.errors import InputError
from services.core.files.meshes import write_mapped_mesh, write_mesh
from services.core.geometry import Camera, Light, Mesh, Tooth, Vector3, inner_file, teeth_folder
from services.core.pages.object_words import PARTS
from services.core.records import Boundary
from services.core.results import Estimate, FitReport
from services.core.store import write_atomic
from services.core.surface.rough import DEFAULT_ROUGHNESS
from services.core.verdict import VERDICT, verdict_of
from services.transport.optics.parameters import MEDIUM_FIELDS, Medium, Mouth, Tissue
from services.transport.scene.stain_uv import ToothStains

SHIPPED = Path(__file__).parent / "mitsuba" / "shipped"
NOT_CONVERGED = "NOT-CONVERGED.txt"
"""File in the asset of a fit that did not converge, with advice on what to do."""


def write_asset(
    folder: Path,
    report: FitReport,
    teeth: tuple[Tooth, ...],
    cameras: tuple[Camera, ...],
    lights: tuple[Light, ...],
    *,
    channels: tuple[str, ...],
    boundary: Boundary,
    ior: float,
    gums: Mesh | None = None,
    cavity: Mesh | None = None,
    stains: ToothStains | None = None,
    colours: CapturedColours | None = None,
) -> tuple[str, ...]:
    """Write meshes, one Mitsuba scene per channel, parameters.json and errors.json; return the files' paths relative to
    ``folder``.

    Args:
        teeth: with the **fitted** dentin surface (``DentinShape.vertices_mm(shape)``) where the fit had one.
        lights: ``intensity`` in the order of ``channels``.
        gums, cavity: surfaces of a jaw; None for a single tooth.
        stains: stain textures of a single tooth.
        colours: colours of the cameras; None where none is known.

    Raises:
        CaptureInputError: a camera that Mitsuba cannot render.
        MeshError: surfaces of a jaw that cannot be cut along each other.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for tooth in teeth:
        place = teeth_folder(Path(), tooth.fdi)
        inner = place / inner_file(tooth.fdi)
        files[str(tooth.fdi)] = (place / "outer.ply", inner if tooth.dentin is not None else None)
        if stains is None:
            write_mesh(folder / place / "outer.ply", tooth.outer)
        else:
            write_mapped_mesh(folder / place / "outer.ply", tooth.outer, stains.corners_uv)
        if tooth.dentin is not None:
            write_mesh(folder / inner, tooth.dentin)
    for name, mesh in (("gums.ply", gums), ("cavity.ply", cavity)):
        if mesh is not None:
            write_mesh(folder / name, mesh)
    cut = write_mouth_surfaces(folder / "surfaces", teeth, gums, cavity) if report.teeth else {}
    surfaces = {name: path.relative_to(folder) for name, path in cut.items()}

    textures = {}
    if stains is not None:
        (tooth,) = teeth
        textures = {
            channel: path.relative_to(folder)
            for channel, path in write_textures(teeth_folder(folder, tooth.fdi), stains).items()
        }

    first, scenes, rough = lights[0], dict[str, SceneDict](), report.surface
    facets: dict[str, Any] = {
        "roughness": DEFAULT_ROUGHNESS if rough is None else rough.roughness.value,
        "compensated": rough is not None and rough.multiple_scattering,
    }
    shown = tuple(with_square_pixels(camera) for camera in cameras)
    position = [SceneParameter(f"light_{axis}", value) for axis, value in zip("xyz", first.position_mm, strict=True)]
    for index, channel in enumerate(channels):
        intensity = SceneParameter("intensity", first.intensity[index])
        samples = SceneParameter("spp", 256)
        if report.teeth:
            numbers, mouth = tuple(tooth.fdi for tooth in teeth), mouth_of(report, channel)
            scene = mouth_scene(
                surfaces, numbers, mouth, shown, position, intensity, boundary=boundary, ior=ior, samples=samples,
                **facets,
            )  # fmt: skip
        else:
            tissue = tissue_of(report.parameters[channel])
            stained = dict.fromkeys(files, textures[channel]) if channel in textures else {}
            scene = nested_scene(
                files, tissue, shown, position, intensity, boundary=boundary, ior=ior, samples=samples, stains=stained,
                **facets,
            )  # fmt: skip
        scenes[channel] = scene | _large_cameras(shown, samples) | {"integrator": shell_integrator()}
        write_scene(folder / f"scene_{channel}.xml", scenes[channel])
    if boundary == "thin":
        colour = "none"
        write_shell_scene(folder / DIELECTRIC_SCENE, {name: as_dielectric(scene) for name, scene in scenes.items()})
    else:
        colour = write_shell_scene(folder / "scene.xml", scenes)

    names = tuple(camera.name for camera in cameras)
    known = colours or CapturedColours()
    media = coloured_media(media_of(report), known, names)
    if media:
        _write_json(folder / "colour.json", colour_tables(media))
    if media and boundary == "matched" and not report.teeth and stains is None:
        scene, white = scenes[channels[0]], float(np.mean(first.intensity))
        write_scene(folder / "scene_srgb.xml", srgb_scene(scene, media, white))
        write_scene(folder / "scene_spectral.xml", spectral_scene(scene, media, white))

    rig = {
        "units": "mm",
        "boundary": boundary,
        "ior": ior,
        "channels": list(channels),
        "cameras": list(names),
        "scene.xml": colour,
        "views": {camera.name: camera.model_dump(exclude={"name"}) for camera in shown},
        "lights": {light.name: {"position_mm": light.position_mm, "intensity": light.intensity} for light in lights},
    }
    if rough is not None:
        rig |= {"roughness": rough.roughness.value, "multiple_scattering": rough.multiple_scattering}
    told = rig_colours(known, channels, names, middle_of(teeth))
    _write_json(folder / "rig.json", rig if told is None else rig | {"colour": told})
    _write_json(folder / "parameters.json", parameters_json(report))
    _write_json(folder / "errors.json", errors_json(report))
    if not (verdict := verdict_of(report)).converged:
        write_atomic(folder / NOT_CONVERGED, f"The fit did not converge. {verdict.headline} {report.advice}\n".encode())
    for name in ("render.py", "thin_boundary.py") if boundary == "thin" else ("render.py",):
        write_atomic(folder / name, (SHIPPED / name).read_bytes())
    return tuple(sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()))


def middle_of(teeth: Sequence[Tooth]) -> Vector3:
    """Middle of the box around the teeth, mm."""
    vertices = np.concatenate([tooth.outer.vertices_mm for tooth in teeth])
    x, y, z = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return float(x), float(y), float(z)


def _large_cameras(cameras: Sequence[Camera], samples: SceneParameter) -> SceneDict:
    # Films that are large enough to be looked at; their size is a parameter of the file.
    found: SceneDict = {}
    for k, camera in enumerate(cameras):
        width, height = large_film(camera)
        film = SceneParameter(f"width_{k}", width), SceneParameter(f"height_{k}", height)
        found[f"camera_{camera.name}"] = sensor_dict(camera, samples, film)
    return found


def write_shell_scene(path: Path, scenes: dict[str, SceneDict]) -> str:
    """Write the scene for ``mitsuba scene.xml``; return what it shows: ``rgb``, ``rgb of similar media`` where the
    channels' phase functions differ, or the name of the one channel.
    """
    if set(RGB) <= scenes.keys():
        with suppress(InputError):  # textures of single channels cannot be joined
            joined = colour_scene([scenes[channel] for channel in RGB])
            write_scene(path, joined.scene)
            return "rgb" if joined.is_exact else "rgb of similar media"
    channel, scene = next(iter(scenes.items()))
    write_scene(path, scene)
    return channel


def tissue_of(table: dict[str, Estimate]) -> Tissue:
    """Tissue of a table of estimates, of a tooth or an object; a part that was not modelled is an empty medium."""
    outer, inner = PARTS.values() if any(name.startswith("body.") for name in table) else PARTS
    return Tissue(medium_of(table, outer), medium_of(table, inner))


def mouth_of(report: FitReport, channel: str) -> Mouth:
    """Mouth of a jaw's report in one channel, with the teeth in the report's order."""
    table = report.parameters[channel]
    gums = medium_of(table, "gums") if "gums.sigma" in table else None
    reflectance = table["cavity.reflectance"].value if "cavity.reflectance" in table else None
    return Mouth(tuple(tissue_of(tooth.parameters[channel]) for tooth in report.teeth.values()), gums, reflectance)


def media_of(report: FitReport) -> dict[str, dict[str, Medium]]:
    """All media of a report by name, a jaw's with the tooth's number such as ``11.enamel``, and by channel."""
    found: dict[str, dict[str, Medium]] = {}
    tables = [("", report.parameters), *((f"{fdi}.", tooth.parameters) for fdi, tooth in report.teeth.items())]
    for prefix, by_channel in tables:
        for channel, table in by_channel.items():
            for part in ("enamel", "dentin", "gums"):
                if f"{part}.sigma" in table:
                    found.setdefault(prefix + part, {})[channel] = medium_of(table, part)
    return found


def medium_of(table: dict[str, Estimate], part: str) -> Medium:
    """Medium of a table of estimates by its part, such as ``enamel``; an empty one where it was not modelled."""
    values: dict[str, Any] = {
        field: table[f"{part}.{field}"].value for field in MEDIUM_FIELDS if f"{part}.{field}" in table
    }
    return Medium(**values) if {"sigma", "alpha"} <= set(values) else Medium(0.0, 0.0)


def parameters_json(report: FitReport) -> dict[str, Any]:
    """Estimates per channel and name as JSON values: value, se, unit, determined, se_parts; the instrument's errors and
    a rough surface are included.
    """
    tables = {channel: dict(table) | report.instrument.get(channel, {}) for channel, table in report.parameters.items()}
    for fdi, tooth in report.teeth.items():
        for channel, own in tooth.parameters.items():
            tables[channel] |= {f"{fdi}.{name}": estimate for name, estimate in own.items()}
            if tooth.enamel_thickness is not None:
                tables[channel][f"{fdi}.enamel.thickness"] = tooth.enamel_thickness
    if report.enamel_thickness is not None:
        for table in tables.values():
            table["enamel.thickness"] = report.enamel_thickness
    if report.surface is not None:
        for table in tables.values():
            table.update(report.surface.estimates())
    return {channel: {name: _plain(estimate) for name, estimate in table.items()} for channel, table in tables.items()}


def _plain(estimate: Estimate) -> dict[str, Any]:
    return estimate.model_dump(exclude=None if estimate.se_parts else {"se_parts"})


def errors_json(report: FitReport) -> dict[str, Any]:
    """Relative image errors per channel as JSON values, with the verdict on the fit's convergence."""
    verdict = verdict_of(report)
    errors = {
        "unit": "1",
        "fit_error": report.fit_error,
        "fit_error_se": report.fit_error_se,
        "held_out_error": report.held_out_error,
        "held_out_error_se": report.held_out_error_se,
        "converged": verdict.converged,
        VERDICT: verdict.model_dump(mode="json"),
        "advice": report.advice,
        "notes": report.notes,
        "instrument": report.instrument_told,
        "told": report.told,
        "next_capture": report.next_capture,
        "correlations": {channel: found.model_dump() for channel, found in report.correlations.items()},
    }
    teeth = {
        fdi: tooth.model_dump(include={"state", "sentence", "fit_error", "held_out_error"})
        for fdi, tooth in report.teeth.items()
    }
    return errors | ({"teeth": teeth} if teeth else {})


def _write_json(path: Path, value: object) -> None:
    write_atomic(path, (json.dumps(value, indent=1) + "\n").encode())
