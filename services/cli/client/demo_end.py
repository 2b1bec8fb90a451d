"""The end of ``dentine demo``: the fit beside the simulated truth, what to try next, and where the picture is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.core.results import AssetManifest


def tell_end(asset: AssetManifest, out: Path, *, as_json: bool) -> None:
    """Print reduced scattering beside the truth, the errors, the next command and the path of the report's first
    picture.

    Raises:
        typer.Exit: the fit did not converge.
    """
    from services.assets.provenance.departing import BESIDE_PHOTOGRAPH
    from services.cli.run import asset_lines, asset_values
    from services.cli.verdict import require_converged
    from services.phantom.truth import compared_scattering, scattering_lines

    compared, picture = compared_scattering(out), out / "asset" / BESIDE_PHOTOGRAPH
    if as_json:
        found = [one.as_json() for one in compared]
        print(json.dumps(asset_values(asset, out) | {"reduced_scattering": found, "picture": str(picture)}))
    else:
        print("\n".join([*scattering_lines(compared), *asset_lines(asset, out)]))
        print(f"next: dentine export {out} --to blender gltf\npicture: {picture}", flush=True)
    if asset.verdict is not None:
        require_converged(asset.verdict)
