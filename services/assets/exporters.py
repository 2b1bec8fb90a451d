"""The seam of exporters: each writes an asset for one kind of program into a folder beside the published asset.

An exporter is a folder of this package with a class that has the methods of ``Exporter``, and one line in
``EXPORTERS``.
"""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from services.assets.content import AssetContent, read_content
from services.assets.provenance.departing import departing, seal
from services.assets.slab_content import is_slab, read_slab
from services.assets.textures.files import write_textures
from services.assets.textures.job import bake_textures
from services.core.choices import chosen
from services.core.files.folders import require_folder
from services.core.installed import require_packages
from services.core.records import JobSpec
from services.core.results import AssetManifest
from services.core.store import open_stage, translate_disk_errors

EXPORTERS: Mapping[str, str] = MappingProxyType(
    {
        "blender": "services.assets.blender.exporter:BlenderExporter",
        "gltf": "services.assets.gltf.exporter:GltfExporter",
        "usd": "services.assets.usd.exporter:UsdExporter",
    }
)
"""Name of an exporter -> ``module:class``, imported when it is used."""

PACKAGES = ("OpenEXR", "PIL", "scipy", "xatlas")
"""Packages of the extra ``fit`` that charts and textures need, by the names under which they are imported."""


class Exporter(Protocol):
    """Writes one format."""

    def check(self) -> None:
        """Refuse to begin where a package is missing.

        Raises:
            PlatformError: names the package and its extra.
        """

    def write(self, content: AssetContent, folder: Path) -> None:
        """Write all files into a folder that holds nothing but the ``textures`` of the content."""


def export_to(
    job: Path,
    names: Sequence[str],
    spec: JobSpec | None = None,
    *,
    use: str | None = None,
    with_photographs: bool = True,
) -> tuple[Path, ...]:
    """Write the published asset of a job by some exporters; return a folder ``asset-<name>`` for each, in place of an
    earlier one. Each folder holds the asset's provenance and a list of hashes.

    Args:
        job: the job's folder.
        names: exporters, by their names in ``EXPORTERS``.
        spec: the job's options, which a standard error of the thickness needs; None where they are not known.
        use: what the exports are for, as the person's consent names it.
        with_photographs: whether pictures that show a photograph, and hashes of photographs, go along.

    Raises:
        SettingsError: an exporter is not known. InputError: the job's folder takes no files. StoreError: the asset is
            absent or damaged. MeshError: a surface is open. ConsentError: the person has not agreed. PlatformError: a
            package is missing.
    """
    exporters = {name: _exporter(name) for name in names}
    for exporter in exporters.values():
        exporter.check()
    require_packages(PACKAGES, "fit")
    require_folder(job, "Folder")
    content = _content(job)
    provenance = departing(job, content.folder, use, datetime.now(UTC), with_photographs=with_photographs)
    textures = bake_textures(job, spec, content)

    def write(name: str, exporter: Exporter) -> Path:
        def fill(folder: Path) -> None:
            exporter.write(replace(content, textures=write_textures(folder, textures)), folder)
            seal(folder, provenance, name, with_photographs=with_photographs)

        return write_anew(job / f"asset-{name}", fill)

    return tuple(write(name, exporter) for name, exporter in exporters.items())


def _content(job: Path) -> AssetContent:
    folder, manifest = open_stage(job, "asset", AssetManifest)
    return read_slab(job, folder, manifest) if is_slab(folder) else read_content(job)


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
        try:
            partial.mkdir()
            fill(partial)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        if final.exists():
            final.rename(retired)
        partial.rename(final)
        shutil.rmtree(retired, ignore_errors=True)
    return final
