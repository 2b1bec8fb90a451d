"""``dentine colmap``: cameras and poses from a COLMAP model as a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def colmap_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Folder of cameras, images and points3D.")],
    out: Annotated[Path, typer.Option(help="The calibration.json to write.")],
    lights: Annotated[
        Path | None, typer.Option(help="Table name,x,y,z[,intensity] of the lights, in the model's frame and unit.")
    ] = None,
    raw: Annotated[
        Path | None, typer.Option(help="Raw folder whose mirror sphere shows the lights, in place of --lights.")
    ] = None,
    scale: Annotated[float | None, typer.Option(help="Length of the model's unit, mm.")] = None,
    distance: Annotated[
        tuple[str, str, float] | None,
        typer.Option(metavar="A B MM", help="Distance between two points (by number) or images (by name), mm."),
    ] = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(metavar="CAMERA=IMAGE", help="A camera and its image; default: all images, by their names."),
    ] = None,
    channels: Annotated[str, typer.Option(help="Channels of the photographs, parted by commas.")] = "red,green,blue",
    radiance_per_count: Annotated[
        float | None,
        typer.Option(help="Radiance of one count at 1 s and gain 1, in intensity per mm²; raw folders need it."),
    ] = None,
    mesh: Annotated[
        Path | None, typer.Option(help="The object's surface in the model's frame: written in mm as object/outer.ply.")
    ] = None,
) -> None:
    """Write a COLMAP model's cameras, with the lights around it, as a calibration."""
    from services.calibrate.photogrammetry.colmap import ColmapModel, KnownDistance
    from services.calibrate.photogrammetry.lights_table import read_lights
    from services.calibrate.photogrammetry.record import calibration_of, cameras_of, scale_of, with_scale_of_counts
    from services.calibrate.photogrammetry.spheres import lights_by_spheres
    from services.core.errors import InputError
    from services.core.raw.folder import DESCRIPTION
    from services.core.store import write_record

    found = ColmapModel(model)
    mm_per_unit = scale_of(found, scale, None if distance is None else KnownDistance(*distance))
    names = [name.strip() for name in channels.split(",")]
    cameras = cameras_of(found, camera or (), mm_per_unit)
    if (lights is None) == (raw is None):
        raise InputError("Where the lights are is told by either --lights or --raw; give one of them.")
    uncertainty, others = None, [lights] if lights is not None else []
    if lights is not None:
        lit_by = read_lights(lights, names, mm_per_unit)
    elif raw is not None:
        lit = lights_by_spheres(raw, cameras, found.distance * mm_per_unit)
        names, cameras, lit_by, uncertainty = list(lit.channels), lit.cameras, lit.lights, lit.uncertainty
        others = [raw / DESCRIPTION]
    if radiance_per_count is not None:
        cameras = with_scale_of_counts(cameras, radiance_per_count, len(names))
    record = calibration_of(found, cameras, lit_by, names, others, uncertainty)
    if mesh is not None:
        from services.core.files.meshes import read_mesh, write_mesh
        from services.core.geometry import Mesh

        surface = read_mesh(mesh)
        write_mesh(out.parent / "object" / "outer.ply", Mesh(surface.vertices_mm * mm_per_unit, surface.faces))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_record(out, record)
    print(f"{out}: {len(record.cameras)} cameras, {len(record.lights)} lights, {mm_per_unit:.6g} mm per unit")
