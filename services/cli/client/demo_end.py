"""The end of ``dentine demo``: the fit beside the simulated truth, a picture in colour, and what to try next."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.core.results import AssetManifest

PICTURE = "photograph-and-render.png"
"""The photograph beside the asset's render, in the job's folder."""
PICTURE_SAMPLES = 256
"""Paths per pixel of the render, half of the photograph's, which take some 20 s of two cores."""


def tell_end(asset: AssetManifest, out: Path, *, as_json: bool) -> None:
    """Print reduced scattering beside the truth, the errors, the next command and the picture's path.

    Raises:
        typer.Exit: the fit did not converge.
    """
    from services.assets.colour.beside import beside, picture
    from services.cli.run import asset_lines, asset_values
    from services.cli.verdict import require_converged
    from services.core.pages.pictures import png_bytes
    from services.core.store import write_atomic
    from services.phantom.truth import compared_scattering, scattering_lines

    compared = compared_scattering(out)
    if not as_json:
        print("\n".join([*scattering_lines(compared), *asset_lines(asset, out)]), flush=True)
    try:
        if asset.verdict is not None:
            require_converged(asset.verdict)
    finally:
        shown = out / PICTURE
        write_atomic(shown, png_bytes(picture(beside(out, PICTURE_SAMPLES), "Simulated photograph")))
        if as_json:
            found = [one.as_json() for one in compared]
            print(json.dumps(asset_values(asset, out) | {"reduced_scattering": found, "picture": str(shown)}))
        else:
            print(f"next: dentine export {out} --to blender gltf\npicture: {shown}")
