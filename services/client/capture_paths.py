"""Rules for the paths of a capture's files: the client applies them before it reads a file, the server before it
accepts a manifest.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from pathlib import PurePosixPath

from services.client.errors import UploadError

MAX_PATH_BYTES = 240
MAX_PARTS = 12
TEXTS = frozenset({".csv", ".json", ".jsonl", ".toml"})
IMAGES = frozenset({".npy", ".png", ".tif", ".tiff", ".exr"})
MESHES = frozenset({".ply", ".obj", ".stl"})
DESCRIPTIONS = frozenset({"capture.json", "manifest.json", "raw.toml", "slab.json"})
"""Names of the files of which one makes a folder a capture: of linear images, of the capture stage's result, of raw
photographs, or of a material in a cell."""

_CHUNK = re.compile(r"(.*/)?[^/]+\.zarr/(.*/)?c(/\d+)+")


def require_paths(paths: Iterable[str]) -> None:
    """Refuse paths that cannot be the files of one capture.

    Raises:
        UploadError: there is such a path; the message names the first one and what is wrong with it.
    """
    files: set[str] = set()
    spellings: dict[str, str] = {}
    folders: set[str] = set()
    for path in paths:
        if (fault := path_fault(path)) is not None:
            raise UploadError(f"File {path!r} {fault}.")
        if path in files:
            raise UploadError(f"File {path!r} is listed twice; list it once.")
        files.add(path)
        above = [str(folder) for folder in PurePosixPath(path).parents][:-1]
        folders.update(above)
        for own in (path, *above):
            if (other := spellings.setdefault(_case_folded(own), own)) != own:
                raise UploadError(
                    f"File {path!r}: {own!r} and {other!r} are the same to some file systems; rename one."
                )
    if both := sorted(files & folders):
        raise UploadError(f"File {both[0]!r} is a folder of other files too; rename one.")
    if not files & DESCRIPTIONS:
        raise UploadError(
            f"The capture holds neither {' nor '.join(sorted(DESCRIPTIONS))}; one of them must say what it is."
        )


def path_fault(path: str) -> str | None:
    """The fault of a path and its remedy, as a clause; None if the path is accepted."""
    parts = path.split("/")
    if path.startswith("/"):
        return "is absolute; give it relative to the capture's folder"
    if any(part in {"", ".", ".."} for part in parts):
        return "is not normalised; leave out empty parts, '.' and '..'"
    if any(
        unicodedata.category(letter)[0] == "C" or letter == "\\" or (letter.isspace() and letter != " ")
        for letter in path
    ):
        return "has a control character, a backslash or a special space; rename it"
    if unicodedata.normalize("NFC", path) != path:
        return "is not in Unicode's normal form C; rename it"
    if any(part.startswith(".") for part in parts):
        return "is hidden; leave it out or rename it"
    if any(part != part.strip(" ").rstrip(".") for part in parts):
        return "has a part that begins or ends with a space or ends with a dot; rename it"
    if len(parts) > MAX_PARTS:
        return f"lies {len(parts) - 1} folders deep and {MAX_PARTS - 1} are allowed; move it up"
    if len(path.encode()) > MAX_PATH_BYTES:
        return f"has a path of {len(path.encode())} bytes and {MAX_PATH_BYTES} are allowed; shorten it"
    if PurePosixPath(path).suffix.lower() not in TEXTS | IMAGES | MESHES and not _CHUNK.fullmatch(path):
        return (
            f"is no file of a capture; it holds {', '.join(sorted(TEXTS | IMAGES | MESHES))} and chunks of .zarr"
            " arrays, and archives are not unpacked"
        )
    return None


def _case_folded(path: str) -> str:
    return unicodedata.normalize("NFC", unicodedata.normalize("NFKC", path).casefold())
