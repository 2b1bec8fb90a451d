"""``dentine phantom``: a virtual mouth for simulated cameras."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from services.core.errors import InputError


class RendererName(StrEnum):
    """The renderer of a phantom."""

    ENGINE = "engine"
    MITSUBA = "mitsuba"


class BoundaryName(StrEnum):
    """Model of the enamel surface."""

    MATCHED = "matched"
    THIN = "thin"
    ROUGH = "rough"


class SwitchName(StrEnum):
    """Whether something is done."""

    ON = "on"
    OFF = "off"


def phantom(
    out: Annotated[Path, typer.Option(help="Folder to write the rig, meshes, images and known optics to.")],
    jaw: Annotated[
        bool, typer.Option("--jaw", help="A whole upper jaw with gums and the mouth's wall instead of one tooth.")
    ] = False,
    shape: Annotated[
        str | None,
        typer.Option(
            "--object",
            metavar="SHAPE",
            help="An object that is no tooth: sphere, cube, or the file of a closed surface.",
        ),
    ] = None,
    core: Annotated[Path | None, typer.Option(help="Surface of the object's core, of another medium.")] = None,
    subject: Annotated[
        int | None, typer.Option(min=0, help="Whose jaw: a number draws shapes and optics; default: the average.")
    ] = None,
    scan: Annotated[Path | None, typer.Option(help="Labelled scan (.vtp or .ply) to take the jaw from.")] = None,
    pixel_mm: Annotated[
        float | None,
        typer.Option(min=0.01, help="Size of a pixel at the teeth, mm; default: 0.5 for a tooth, 1 for a jaw."),
    ] = None,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras.")] = 3,
    lights: Annotated[int, typer.Option(min=1, help="Number of lights, held-out ones included.")] = 8,
    held_out: Annotated[
        int | None, typer.Option(min=0, help="How many of the lights are kept from the fit; default: every fourth.")
    ] = None,
    channels: Annotated[int, typer.Option(min=1, max=3, help="1 (green) or 3 (red, green, blue).")] = 1,
    boundary: Annotated[BoundaryName, typer.Option(help="Model of the enamel surface.")] = BoundaryName.MATCHED,
    ior: Annotated[
        float | None, typer.Option(help="Index of refraction of enamel, or of the object; default: 1.631.")
    ] = None,
    roughness: Annotated[
        float | None, typer.Option(help="GGX roughness of a rough boundary, 0.02 to 1; default: 0.15.")
    ] = None,
    multiple_scattering: Annotated[
        SwitchName | None,
        typer.Option(help="Of a rough boundary: give back light that meets several facets; default: on."),
    ] = None,
    renderer: Annotated[
        RendererName,
        typer.Option(help="The project's engine, or stock Mitsuba for a matched boundary or a rough one."),
    ] = RendererName.ENGINE,
    samples: Annotated[int, typer.Option(min=1, help="Paths per pixel.")] = 1024,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    outer: Annotated[Path | None, typer.Option(help="Enamel surface to use instead of the procedural one.")] = None,
    dentin: Annotated[Path | None, typer.Option(help="Dentin surface to use instead of the procedural one.")] = None,
    fdi: Annotated[
        int | None,
        typer.Option(
            help="FDI number of the tooth that --outer gives; default: 11. A fit takes dentin's shape from it."
        ),
    ] = None,
    highlights: Annotated[
        bool, typer.Option("--highlights", help="Add the surface's reflection of each light.")
    ] = False,
    gums: Annotated[bool, typer.Option("--gums", help="Cover the root with gums.")] = False,
    stains: Annotated[bool, typer.Option("--stains", help="Paint stains on the enamel.")] = False,
    lips: Annotated[
        bool, typer.Option("--lips", help="Put lips and a retractor before the teeth, which throw shadows.")
    ] = False,
) -> None:
    """Render a virtual mouth for the simulated cameras to look at."""
    from services.core.files.folders import require_folder

    require_folder(out, "--out")
    of_jaw = {"--scan": scan is not None, "--lips": lips}
    of_tooth = {"--outer": outer is not None, "--dentin": dentin is not None, "--fdi": fdi is not None}
    of_tooth |= {"--highlights": highlights, "--gums": gums, "--stains": stains}
    if shape is None and core is not None:
        raise InputError("Option --core is for an object; add --object.")
    of_teeth = {"--jaw": jaw, "--subject": subject is not None}
    if shape is not None and (other := next((o for o, given in (of_teeth | of_jaw | of_tooth).items() if given), None)):
        raise InputError(f"Option {other} is for teeth; leave out either it or --object.")
    for option, given in (of_tooth if jaw else of_jaw).items():
        if given:
            raise InputError(
                f"Option {option} is for one tooth; leave out either it or --jaw."
                if jaw
                else f"Option {option} is for a jaw; add --jaw."
            )
    face: dict[str, Any] = {"ior": ior, "roughness": roughness}
    face |= {"multiple_scattering": None if multiple_scattering is None else multiple_scattering is SwitchName.ON}
    face = {name: value for name, value in face.items() if value is not None}
    for name in face:
        option = "--" + name.replace("_", "-")
        if name != "ior" and boundary is not BoundaryName.ROUGH:
            raise InputError(f"Option {option} is for a rough boundary; add --boundary rough.")
    rig: dict[str, Any] = {
        "cameras": cameras,
        "lights": lights,
        "held_out": held_out,
        "channels": channels,
        "seed": seed,
        "samples": samples,
    }
    rig |= {"boundary": boundary.value, "renderer": renderer.value} | (
        {} if pixel_mm is None else {"pixel_mm": pixel_mm}
    )
    rig |= face
    if shape is not None:
        from services.phantom.object import write_object_phantom

        write_object_phantom(out, shape=shape, core=core, **rig)
    elif jaw:
        from services.phantom.jaw import write_jaw_phantom

        write_jaw_phantom(out, subject=subject, scan=scan, lips=lips, **rig)
    else:
        from services.phantom.tooth import write_phantom

        write_phantom(
            out,
            outer=outer,
            dentin=dentin,
            fdi=fdi,
            highlights=highlights,
            gums=gums,
            stains=stains,
            subject=subject,
            **rig,
        )
    print(f"phantom: {out}")
