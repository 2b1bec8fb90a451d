"""The seam of exporters: each writes an asset for one kind of program into a folder beside the published asset.

An exporter is a folder of this package with a class that has the methods of ``Exporter``, and one line in
``EXPORTERS``.
"""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from services.assets.content import AssetContent, read_content
from services.assets.provenance.departing import departing, seal
from services.core.choices import chosen
from services.core.files.folders import require_folder
from services.core.store import translate_disk_errors

EXPORTERS: Mapping[str, str] = MappingProxyType(
    {
        "blender": "services.assets.blender.exporter:BlenderExporter",
        "gltf": "services.assets.gltf.exporter:GltfExporter",
        "usd": "services.assets.usd.exporter:UsdExporter",
    }
)
"""Name of an exporter -> ``module:class``, imported when it is used."""


class Exporter(Protocol):
    """Writes one format."""

    def check(self) -> None:
        """Refuse to begin where a package is missing.

        Raises:
            PlatformError: names the package and its extra.
        """

    def write(self, content: AssetContent, folder: Path) -> None:
        """Write all files into an empty folder."""


def export_to(
    job: Path, names: Sequence[str], *, use: str | None = None, with_photographs: bool = True
) -> tuple[Path, ...]:
    """Write the published asset of a job by some exporters; return a folder ``asset-<name>`` for each, in place of an
    earlier one. Each folder holds the asset's provenance and a list of hashes.

    Args:
        use: what the exports are for, as the person's consent names it.
        with_photographs: whether pictures that show a photograph, and hashes of photographs, go along.

    Raises:
        SettingsError: an exporter is not known. InputError: the job's folder takes no files. StoreError: the asset is
            absent or damaged. MeshError: a surface is open. ConsentError: the person has not agreed.
    """
    exporters = {name: _exporter(name) for name in names}
    for exporter in exporters.values():
        exporter.check()
    require_folder(job, "Folder")
    content = read_content(job)
    provenance = departing(job, content.folder, use, datetime.now(UTC), with_photographs=with_photographs)

    def write(name: str, exporter: Exporter) -> Path:
        def fill(folder: Path) -> None:
            exporter.write(content, folder)
            seal(folder, provenance, name, with_photographs=with_photographs)

        return write_anew(job / f"asset-{name}", fill)

    return tuple(write(name, exporter) for name, exporter in exporters.items())


def _exporter(name: str) -> Exporter:
    module, _, kind = chosen("Exporter", name, EXPORTERS).partition(":")
    exporter: Exporter = getattr(importlib.import_module(module), kind)()
    return exporter


def write_anew(final: Path, fill: Callable[[Path], None]) -> Path:
    """Fill a folder in place of an earlier one; readers see the old folder or the new one, never a half of it."""
    partial, retired = (final.with_name(f".{final.name}.{what}") for what in ("partial", "retired"))
    with translate_disk_errors(final.parent):
        for left in (partial, retired):
            shutil.rmtree(left, ignore_errors=True)
        partial.mkdir()
        fill(partial)
        if final.exists():
            final.rename(retired)
        partial.rename(final)
        shutil.rmtree(retired, ignore_errors=True)
    return final
