"""The asset that a job has exported, read from the job's folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from services.core.errors import CorruptStoreError
from services.core.results import AssetManifest, Estimate
from services.core.store import open_stage

PARAMETERS = "parameters.json"


@dataclass(frozen=True)
class Asset:
    """A measured tooth, jaw or material."""

    folder: Path
    """Folder of the scenes, meshes and scripts."""
    manifest: AssetManifest
    parameters: Mapping[str, Mapping[str, Estimate]]
    """Channel -> name, such as ``enamel.sigma`` -> value, standard error and unit."""

    def scene(self, channel: str) -> Path:
        """Path of the scene of one colour channel, for ``mitsuba.load_file``.

        Raises:
            CorruptStoreError: the asset has no scene for this channel.
        """
        path = self.folder / f"scene_{channel}.xml"
        if not path.is_file():
            raise CorruptStoreError(f"{path} is not there; the asset has the channels {', '.join(self.parameters)}.")
        return path


def load_asset(job: str | Path) -> Asset:
    """Load the asset of a job from the job's folder.

    Raises:
        MissingStageError: the job has exported no asset. CorruptStoreError: a file is not as it was published.
    """
    folder, manifest = open_stage(Path(job), "asset", AssetManifest)
    path = Path(job) / PARAMETERS
    try:
        tables = json.loads(path.read_text(encoding="utf-8"))
        parameters = {
            channel: {name: Estimate.model_validate(value) for name, value in table.items()}
            for channel, table in tables.items()
        }
    except (OSError, ValueError, AttributeError) as problem:
        raise CorruptStoreError(f"{path} cannot be read ({problem}); write it again with dentine export.") from problem
    return Asset(folder, manifest, parameters)
