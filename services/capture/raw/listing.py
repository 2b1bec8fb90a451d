"""The photographs of a folder: which files are taken, which are left out, and what is said about those."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from services.capture.raw.names import NamedFrame, named_frame
from services.core.errors import CaptureInputError
from services.core.files.scans import FORMATS
from services.core.raw.decoding import CAMERA_RAW, JPEG

IMAGES = frozenset({".png", ".tif", ".tiff", ".npy", ".exr", *CAMERA_RAW})
_USED_OTHERWISE = frozenset({*FORMATS, ".toml", ".json", ".csv"})
_KEPT_BY_PROGRAMS = frozenset({"__macosx", "@eadir", "#recycle", "$recycle.bin", "lost+found"})
"""Folders in which systems keep thumbnails and deleted files, in lower case."""
_COPY = re.compile(r"(?:copy of|kopie von) .*|.*(?: \(\d+\)|[ -]+(?:copy|kopie)(?: \d+| \(\d+\))?)|.*~", re.IGNORECASE)
MAX_NAMED = 5
"""Largest number of words or files that a sentence lists."""


@dataclass(frozen=True)
class Listing:
    """The files of a folder.

    Attributes:
        photographs: paths relative to the folder, sorted.
        notes: one sentence on each kind of file that is left out.
    """

    photographs: tuple[str, ...]
    notes: tuple[str, ...]


def photographs_in(root: Path) -> Listing:
    """List the photographs below a folder, without copies and the files that systems keep."""
    kept, copies, hidden, others = list[str](), list[str](), list[str](), Counter[str]()
    for path in sorted(one for one in root.rglob("*") if one.is_file()):
        pure = PurePosixPath(path.relative_to(root).as_posix())
        suffix = pure.suffix.lower()
        if any(part.startswith(".") or part.lower() in _KEPT_BY_PROGRAMS for part in pure.parts):
            hidden.append(str(pure))
        elif suffix in IMAGES or (suffix in JPEG and _is_of_board(str(pure))):
            (copies if _COPY.fullmatch(pure.stem) else kept).append(str(pure))
        elif suffix not in _USED_OTHERWISE:
            others[suffix or "no suffix"] += 1
    return Listing(tuple(kept), tuple(_left_out(copies, hidden, others)))


def _is_of_board(file: str) -> bool:
    named = named_frame(file)
    return isinstance(named, NamedFrame) and named.kind == "board"


def _left_out(copies: Sequence[str], hidden: Sequence[str], others: Mapping[str, int]) -> Iterator[str]:
    if copies:
        yield f"Copies by their names are left out: {_listed(copies)}; rename those that are photographs of their own."
    if hidden:
        yield f"Files that a system keeps are left out: {_listed(hidden)}; move photographs among them elsewhere."
    if others:
        kinds = ", ".join(f"{count} of {kind}" for kind, count in sorted(others.items()))
        of_boards = "; JPEGs may only show boards, named such as left_board1.jpg" if JPEG & set(others) else ""
        yield (
            f"Files that are no photographs of counts are passed over: {kinds}; export photographs among them anew"
            f"{of_boards}."
        )


def require_told_apart(frames: Sequence[NamedFrame]) -> None:
    """Refuse photographs whose names differ only in words without a meaning.

    Raises:
        CaptureInputError: two do; the message names the word and both files.
    """
    alike = defaultdict(list)
    for one in frames:
        alike[one.camera, one.kind, one.light, one.exposure_s, one.gain, one.place].append(one)
    for group in alike.values():
        for other in group[1:]:
            if word := next(iter(sorted(set(group[0].unused) ^ set(other.unused))), None):
                raise CaptureInputError(
                    f"Files {group[0].file} and {other.file} differ only in {word}, which has no meaning here, so they"
                    " would be taken for repetitions; rename them, such as left_L07_0.05s.tif (camera, light,"
                    f" exposure), or give --ignore {word}."
                )


def unused_words(frames: Sequence[NamedFrame]) -> Iterator[str]:
    """Yield a sentence that names the words of file names that have no meaning here."""
    words = Counter(word for one in frames for word in dict.fromkeys(one.unused))
    if words:
        listed = [f"{word} ({count} files)" for word, count in words.most_common()]
        example = next(one.file for one in frames if one.unused)
        yield (
            f"Words of file names are not used: {', '.join(listed)}, as in {example}; rename the files where a word"
            " tells a camera, a light, an exposure or a gain."
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")
