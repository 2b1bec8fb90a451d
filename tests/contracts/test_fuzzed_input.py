"""Any content of a capture, a job file, an array or the environment is either accepted or refused by an error of the
error tree with a one-sentence message. No other exception is raised.
"""

from __future__ import annotations

import copy
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from services.capture.rig import PlannedRig
from services.core.errors import DentineError
from services.core.records import JobSpec, RigSpec, SimulatedCameraSpec
from services.core.settings import read_job, read_settings
from services.core.stage import LocalContext
from services.preprocess.stage import run as prepare
from tests.support.mouth import write_mouth

pytestmark = pytest.mark.filterwarnings(
    "ignore::RuntimeWarning"
)  # warnings of arithmetic with absurd values; only the result counts here
EXAMPLES = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

NUMBERS = st.one_of(
    st.sampled_from(
        [
            0,
            -1,
            1,
            2,
            7,
            65,
            2**15,
            2**31,
            2**63,
            10**30,
            0.0,
            -0.0,
            1e-300,
            5e-324,
            1e-6,
            0.5,
            1e38,
            1e39,
            1e200,
            1.7e308,
            -1e200,
        ]
    ),
    st.integers(-100, 100),
    st.floats(allow_nan=False, allow_infinity=False),
)
TEXTS = st.one_of(
    st.sampled_from(
        [
            "",
            ".",
            "..",
            "/",
            "\\",
            "\0",
            "a\0b",
            "NaN",
            "inf",
            "1e400",
            "simulated",
            "c0",
            "l0",
            "green",
            "x" * 5000,
            "²",
            "\ud7ff",
            "%s",
            "{}",
        ]
    ),
    st.text(max_size=20),
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=3)),
    max_leaves=6,
)


@contextmanager
def only_sentences() -> Iterator[None]:
    """Pass if the block succeeds or raises a ``DentineError`` whose message is a sentence on one line."""
    told = "."
    try:
        yield
    except DentineError as problem:
        told = problem.message
    assert told.endswith("."), told
    assert "\n" not in told, told


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Path of every node in a JSON tree except its root."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in inner:
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(tree: Any, path: tuple[Any, ...], change: Callable[[Any, Any], None]) -> Any:
    """A copy of a tree in which ``change(container, key)`` was applied at one path."""
    result = copy.deepcopy(tree)
    holder = result
    for key in path[:-1]:
        holder = holder[key]
    change(holder, path[-1])
    return result


def drop(holder: Any, key: Any) -> None:
    del holder[key]


def repeat(holder: Any, key: Any) -> None:
    if isinstance(holder, list):
        holder.append(copy.deepcopy(holder[key]))
    else:
        holder[f"{key}2"] = holder[key]


@st.composite
def mutations(draw: st.DrawFn, tree: Any) -> Any:
    """A JSON tree with one or two nodes replaced, dropped or repeated."""
    for _ in range(draw(st.integers(1, 2))):
        path = draw(st.sampled_from(list(places(tree))))
        value = draw(VALUES)

        def replace(holder: Any, key: Any, value: Any = value) -> None:
            holder[key] = value

        tree = changed(tree, path, draw(st.sampled_from([replace, replace, replace, drop, repeat])))
    return tree


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_mouth(folder, 2, sizes=((24, 18),))
    for camera in (tree := json.loads((folder / "capture.json").read_text()))["cameras"]:
        camera["K"][0][0] = camera["K"][1][1] = 200.0
    (folder / "capture.json").write_text(json.dumps(tree))
    return folder


@pytest.fixture(scope="module")
def description(capture: Path) -> Any:
    return json.loads((capture / "capture.json").read_text())


def use(folder: Path, root: Path) -> None:
    """Prepare a capture, and plan a rig that looks at it."""
    with only_sentences():
        PlannedRig.read(RigSpec(mouth=folder))
    with only_sentences():
        prepare(JobSpec(capture=folder), LocalContext(root))
    shutil.rmtree(root, ignore_errors=True)


def test_the_capture_is_taken_as_it_is(capture: Path, tmp_path: Path) -> None:
    PlannedRig.read(RigSpec(mouth=capture))
    prepare(JobSpec(capture=capture), LocalContext(tmp_path))


@EXAMPLES
@given(data=st.data())
def test_every_field_of_a_captures_description(
    capture: Path, description: Any, tmp_path: Path, data: st.DataObject
) -> None:
    folder = tmp_path / "capture"
    if not folder.exists():
        shutil.copytree(capture, folder)
    (folder / "capture.json").write_text(json.dumps(data.draw(mutations(description))))
    use(folder, tmp_path / "job")


FILES = ("c0_l1.npy", "teeth/11/outer.ply", "capture.json")


@EXAMPLES
@given(data=st.data(), name=st.sampled_from(FILES))
def test_every_byte_of_a_captures_files(capture: Path, tmp_path: Path, data: st.DataObject, name: str) -> None:
    folder = tmp_path / "capture"
    if not folder.exists():
        shutil.copytree(capture, folder)
    whole = (capture / name).read_bytes()
    start = data.draw(st.one_of(st.integers(0, min(200, len(whole))), st.integers(0, len(whole))))
    end = data.draw(st.one_of(st.just(len(whole)), st.integers(start, len(whole)), st.just(min(start + 1, len(whole)))))
    try:
        (folder / name).write_bytes(whole[:start] + data.draw(st.binary(max_size=40)) + whole[end:])
        use(folder, tmp_path / "job")
    finally:
        (folder / name).write_bytes(whole)


SPECIAL = (0.0, -1.0, 1e-45, 1e38, 3e38, np.nan, np.inf, -np.inf)


@EXAMPLES
@given(
    shape=st.lists(st.sampled_from([0, 1, 3, 18, 24]), max_size=4),
    kind=st.sampled_from(["<f4", ">f4", "<f8", "<f2", "<i4", "?", "<c8", "S3", "<U2", "<M8[s]", "V4", "<f4,<i4"]),
    value=st.sampled_from(SPECIAL),
    as_expected=st.booleans(),
)
def test_every_kind_of_array(
    capture: Path, tmp_path: Path, shape: list[int], kind: str, value: float, as_expected: bool
) -> None:
    folder = tmp_path / "capture"
    if not folder.exists():
        shutil.copytree(capture, folder)
    array = np.zeros((18, 24, 3) if as_expected else tuple(shape), dtype=kind)
    if array.dtype.kind == "f":
        array[...] = value
    np.save(folder / "c0_l1.npy", array)
    use(folder, tmp_path / "job")


def toml(value: Any) -> str:
    """A value as TOML; values without a TOML form become strings."""
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case list():
            return f"[{', '.join(map(toml, value))}]"
        case dict():
            return f"{{{', '.join(f'{json.dumps(key)} = {toml(inner)}' for key, inner in value.items())}}}"
    return json.dumps("" if value is None else value).replace("\x7f", "\\u007F")


JOB_OPTIONS = sorted(set(JobSpec.model_fields) - {"rig"})
RIG_OPTIONS = sorted(set(RigSpec.model_fields) - {"simulation", "mouth"})
CAMERA_OPTIONS = sorted(SimulatedCameraSpec.model_fields)


def plan(path: Path) -> None:
    """Read a job file, and plan its rig if it has one."""
    with only_sentences():
        spec = read_job(path)
        if spec.rig is not None:
            rig = PlannedRig.read(spec.rig)
            rig._cameras("127.0.0.1", 1, time.sleep)  # not opened, so they do not connect


@EXAMPLES
@given(option=st.sampled_from(JOB_OPTIONS), value=VALUES, other=st.sampled_from(JOB_OPTIONS), another=VALUES)
def test_every_option_of_a_job(
    capture: Path, tmp_path: Path, option: str, value: Any, other: str, another: Any
) -> None:
    options = {"capture": str(capture), option: value, other: another}
    (tmp_path / "JOB.toml").write_text(
        "".join(f"{name} = {toml(value)}\n" for name, value in options.items()), errors="replace"
    )
    plan(tmp_path / "JOB.toml")


@EXAMPLES
@example(rig={"black_frames": 10**9}, simulation={})
@example(rig={"exposure_s": 1e300}, simulation={})
@example(rig={"level": 0}, simulation={})
@example(rig={}, simulation={"seed": -1})
@example(rig={}, simulation={"black_level": 4095})
@example(rig={}, simulation={"motion_px": 1e308})
@given(
    rig=st.dictionaries(st.sampled_from(RIG_OPTIONS), st.one_of(NUMBERS, VALUES), max_size=2),
    simulation=st.dictionaries(st.sampled_from(CAMERA_OPTIONS), st.one_of(NUMBERS, VALUES), max_size=2),
)
def test_every_option_of_a_rig(capture: Path, tmp_path: Path, rig: dict[str, Any], simulation: dict[str, Any]) -> None:
    options = {"mouth": str(capture), **rig, "simulation": simulation}
    (tmp_path / "JOB.toml").write_text(
        "[rig]\n" + "".join(f"{name} = {toml(value)}\n" for name, value in options.items()), errors="replace"
    )
    plan(tmp_path / "JOB.toml")


@EXAMPLES
@given(text=st.one_of(st.text(), st.sampled_from(["[", "{", "a.", "a=", "x=1e999", "["]).map(lambda part: part * 3000)))
def test_every_text_as_a_job_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "JOB.toml").write_bytes(text.encode(errors="surrogatepass"))
    plan(tmp_path / "JOB.toml")


SETTING = st.lists(
    st.sampled_from(["SERVER", "CLIENT", "PORT", "DOME", "RATES", "HOST", "TOKEN", "", "X"]), min_size=1, max_size=4
).map("__".join)


@EXAMPLES
@given(environment=st.dictionaries(SETTING.map("DENTINE__{}".format), st.one_of(TEXTS, st.just("1")), max_size=4))
def test_every_variable_of_the_environment(environment: dict[str, str]) -> None:
    with only_sentences():
        read_settings(environment)
