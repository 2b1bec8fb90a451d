"""Which paths the files of a capture may have: every accepted set can be written below a folder safely, on any file
system.
"""

from __future__ import annotations

import unicodedata
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.client.capture_paths import MAX_PARTS, MAX_PATH_BYTES, path_fault, require_paths
from services.client.errors import UploadError

names = st.text(
    st.sampled_from(["a", "B", "ß", "é", "\u0301", ".", " ", "/", "\\", "\0", "\n", "\u202e", "\u2028", "~", "c", "0"]),
    max_size=8,
)
any_path = st.one_of(
    st.text(max_size=30),
    st.lists(names, min_size=1, max_size=4).map("/".join),
    st.lists(names, min_size=1, max_size=4).map(lambda parts: "/".join(parts) + ".npy"),
)


@given(any_path)
def test_an_accepted_path_is_plain_relative_and_visible(path: str) -> None:
    if path_fault(path) is not None:
        return
    pure = PurePosixPath(path)
    assert str(pure) == path
    assert not pure.is_absolute()
    assert not any(part.startswith(".") or part.strip() != part for part in pure.parts)
    assert path.isprintable()
    assert "\\" not in path
    assert unicodedata.is_normalized("NFC", path)
    assert len(path.encode()) <= MAX_PATH_BYTES
    assert len(pure.parts) <= MAX_PARTS
    assert Path("/data/captures/x", path).resolve().is_relative_to("/data/captures/x")


@given(
    st.lists(
        st.lists(st.sampled_from(["a", "A", "ß", "ss", "a.npy", "b"]), min_size=1, max_size=3).map(
            lambda parts: "/".join(parts) + ".npy"
        ),
        max_size=6,
    )
)
def test_accepted_sets_keep_their_files_apart(paths: list[str]) -> None:
    everything = [*paths, "capture.json"]
    try:
        require_paths(everything)
    except UploadError:
        return
    folded = [unicodedata.normalize("NFKC", path).casefold() for path in everything]
    assert len(set(folded)) == len(everything)
    assert not any(path.startswith(f"{other}/") for path in folded for other in folded)


@pytest.mark.parametrize(
    "path",
    [
        "capture.json",
        "teeth/11/outer.ply",
        "c0_l0.NPY",
        "photo 1.png",
        "Zähne/é.exr",
        "capture.zarr/zarr.json",
        "capture.zarr/c/0/12/0/0/0",
        "x/a.zarr/g/c/3",
    ],
)
def test_files_of_captures_are_accepted(path: str) -> None:
    assert path_fault(path) is None


@pytest.mark.parametrize(
    ("path", "named"),
    [
        ("/etc/a.npy", "absolute"),
        ("a/../b.npy", "not normalised"),
        ("a//b.npy", "not normalised"),
        ("./a.npy", "not normalised"),
        ("a.npy/", "not normalised"),
        ("", "not normalised"),
        ("a\0.npy", "control character"),
        ("a\u202e.npy", "control character"),
        ("a\\b.npy", "backslash"),
        ("e\u0301.npy", "normal form"),
        (".npy", "hidden"),
        ("a/.git/b.npy", "hidden"),
        ("a /b.npy", "space"),
        ("a./b.npy", "dot"),
        ("d/" * 12 + "a.npy", "12 folders deep"),
        ("a" * 240 + ".npy", "244 bytes"),
        ("capture.zip", "archives are not unpacked"),
        ("capture.npz", "archives are not unpacked"),
        ("run.sh", "no file of a capture"),
        ("c/0/1", "no file of a capture"),
        ("capture.zarr/c/0/x", "no file of a capture"),
    ],
)
@pytest.mark.attack(
    "traversal", "a file of a capture that is absolute, leads upwards, is hidden or has control characters"
)
def test_other_paths_are_refused_for_a_reason(path: str, named: str) -> None:
    assert named in (path_fault(path) or "")


@pytest.mark.parametrize(
    ("paths", "named"),
    [
        (["a.npy", "a.npy"], "listed twice"),
        (["a.npy", "A.npy"], "the same to some file systems"),
        (["stra\u00dfe.npy", "STRASSE.npy"], "the same to some file systems"),
        (["t/a.npy", "T/b.npy"], "the same to some file systems"),
        (["a.npy", "a.npy/b.npy"], "a folder of other files too"),
        (["a.npy/b.npy", "a.npy"], "a folder of other files too"),
    ],
)
@pytest.mark.attack("traversal", "two files of a capture that some file system takes for one")
def test_paths_that_clash_are_refused(paths: list[str], named: str) -> None:
    with pytest.raises(UploadError, match=named):
        require_paths(["capture.json", *paths])


def test_a_capture_says_what_it_is() -> None:
    with pytest.raises(UploadError, match=r"neither capture\.json nor manifest\.json"):
        require_paths(["a.npy"])
