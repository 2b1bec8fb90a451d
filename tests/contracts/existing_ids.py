"""Ids that exist, and headers and bodies that fit together, for generated requests that must get past the lookup.

The API's description says of an id only that it is text, so a generated id never exists.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from schemathesis import Case, Response
from schemathesis.core.parameters import ParameterLocation

from services.api.masks.images import picture_of
from services.api.presets import list_presets
from services.client.tus import CHUNK_TYPE, format_metadata
from services.core.geometry import Camera
from tests.contracts.kept_data import KeptData
from tests.support.uploading import CAMERA, TUS, checksum, manifest_of

MAX_KEPT = 200
"""Number of the newest objects that later requests can name."""
SPARED = 3
"""Number of the newest objects of a kind that generated requests do not delete."""
HOLD = "hold-fit"
"""Name of the file that makes a toy job wait in its fit."""
PNG_TYPE = "image/png"
DOME_LIGHTS = 155
NOWHERE = "http://127.0.0.1:9/"
"""Address at which no server listens."""
_ID_OF = {"/v1/jobs": "job_id", "/v1/captures": "capture", "/v1/tokens": "token_id", "/v1/webhooks": "webhook_id"}
_FILE = "capture.json"
_LIGHTS = ("l0", "l1", "all")
_UNITS: dict[str, Any] = {"units": "mm", "channels": ["green"], "cameras": [CAMERA]}


def content_of(choice: int) -> bytes:
    """Content of the one file of a small capture; different choices give different files."""
    light = {"name": "l0", "position_mm": [0, 0, -50], "intensity": [1.0]}
    return json.dumps(_UNITS | {"lights": [light]}).encode() + b" " * (choice % 5000)


class ExistingIds:
    """Path parameters of objects that exist on the server. Those of the witnesses are never deleted."""

    def __init__(self, witnesses: KeptData, data: Path, mouth: Path) -> None:
        self._jobs, self._mouth, self._job_count = data / "jobs", mouth, 0
        job, capture = {"job_id": witnesses.job["id"]}, {"capture": witnesses.capture["id"]}
        self._kept: list[dict[str, Any]] = [job, capture, *(job | {"path": path} for path in witnesses.artifacts)]
        self._kept += [job | {"preview_id": preview} for preview in witnesses.previews]
        self._kept += [{"name": preset.name} for preset in list_presets()]
        self._made: list[dict[str, Any]] = []
        self._deleted: list[dict[str, Any]] = []
        self._contents: dict[str, bytes] = {}
        self._source = witnesses.capture["path"]

    def place(self, case: Case[Any], choice: int) -> None:
        """Make a case name an object that exists, unless the case is meant to have a wrong path."""
        known = self._deleted if case.path.startswith("/v1/deletions") else self._kept + self._made
        there = [one for one in known if set(one) <= set(case.path_parameters)]
        if case.method.upper() == "DELETE":
            there = [one for one in there if one not in self._kept][:-SPARED]
        if choice % 4:
            most = max(map(len, there), default=0)
            there = [one for one in there if len(one) == most]
        if there and not _is_wrong(case, ParameterLocation.PATH):
            case.path_parameters = case.path_parameters | there[choice % len(there)]

    def fit(self, case: Case[Any], choice: int) -> None:
        """Change a case that is valid by the description so that the server can carry it out."""
        match f"{case.method.upper()} {case.path}":
            case "POST /v1/jobs":
                kept = {
                    name: value
                    for name, value in _fields(case).items()
                    if name not in {"rig", "held", "samples_per_pixel", "max_samples_per_pixel"}
                }
                case.body = kept | {"capture": self._source if choice % 3 else f"/{kept.get('capture')}", "workers": 1}
                case.headers.pop("idempotency-key", None)
            case "POST /v1/captures":
                case.body = manifest_of({_FILE: content_of(choice)})
            case "POST /v1/webhooks" | "PATCH /v1/webhooks/{webhook_id}":
                case.body = _fields(case) | {"url": NOWHERE}
            case "PUT /v1/calibrations/{name}":
                light = {"name": "l0", "position_mm": [0, 0, -50 - choice % 3], "intensity": [1.0]}
                case.body = _UNITS | {"lights": [light]}
            case "PUT /v1/jobs/{job_id}/masks/{camera}/{light}":
                width, height = Camera.model_validate(CAMERA).size
                case.body, case.media_type = picture_of(np.full((height, width), choice % 2, dtype=np.uint8)), PNG_TYPE
            case "PUT /v1/dome/light":
                case.body = {"light": choice % DOME_LIGHTS, "level": 0.001, "on_s": 0.2}
            case "POST /v1/dome/preflight":
                case.body = {"mouth": str(self._mouth)}
            case "POST /v1/uploads" if self._contents:
                capture, content = list(self._contents.items())[choice % len(self._contents)]
                case.headers.update(
                    TUS
                    | {
                        "upload-length": str(len(content)),
                        "upload-metadata": format_metadata({"capture": capture, "path": _FILE}),
                    }
                )
            case "PATCH /v1/uploads/{capture}/{number}":
                content = self._contents.get(case.path_parameters["capture"], b"{}")
                part = content if choice % 2 else content[: choice % len(content)]
                case.headers.update(
                    TUS | {"upload-offset": "0", "content-type": CHUNK_TYPE, "upload-checksum": checksum(part)}
                )
                case.body, case.media_type = part, CHUNK_TYPE
            case route if "/v1/uploads" in route:
                case.headers.update(TUS)

    def learn(self, case: Case[Any], response: Response) -> None:
        """Remember the objects that a request has made or deleted."""
        if response.status_code not in {200, 201, 202, 204}:
            return
        if case.method.upper() == "DELETE":
            self._made = [one for one in self._made if not case.path_parameters.items() <= one.items()]
            self._deleted = [*self._deleted[-MAX_KEPT:], case.path_parameters]
            if "number" not in case.path_parameters:
                self._contents.pop(case.path_parameters.get("capture", ""), None)
        if case.method.upper() != "POST":
            return
        if name := _ID_OF.get(case.path):
            made = response.json()["id"]
            self._made.append({name: made})
            if name == "job_id":
                self._made += [{name: made, "camera": CAMERA["name"], "light": light} for light in _LIGHTS]
                self._steer(made)
            if name == "capture":
                self._made.append({"capture": made, "number": 0})
                self._contents[made] = content_of(response.json()["bytes"] - len(content_of(0)))
        elif case.path == "/v1/webhooks/{webhook_id}/test":
            self._made.append(case.path_parameters | {"delivery_id": response.json()["id"]})
        self._made = self._made[-MAX_KEPT:]

    def release(self) -> None:
        """Let the waiting jobs go on."""
        for hold in self._jobs.glob(f"*/{HOLD}"):
            hold.unlink()

    def _steer(self, job: str) -> None:
        # Some jobs fail, and some wait and let others queue, so that there are jobs to retry and to cancel.
        self._job_count += 1
        flag = HOLD if self._job_count % 8 == 5 else "bad-input" if self._job_count % 3 == 1 else None
        if flag is not None:
            (self._jobs / job).mkdir(parents=True, exist_ok=True)
            (self._jobs / job / flag).touch()


def _fields(case: Case[Any]) -> dict[str, Any]:
    # Body of a case whose description asks for an object.
    assert isinstance(case.body, dict)
    return case.body


def _is_wrong(case: Case[Any], location: ParameterLocation) -> bool:
    component = case.meta.components.get(location) if case.meta else None
    return component is not None and component.mode.is_negative
