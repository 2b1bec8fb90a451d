"""Options of jobs and phantoms with a rough surface: what they default to, reach and refuse."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from services.cli.app import build_app
from services.core.errors import InputError
from services.core.records import JobSpec
from services.fit.measurements.observations import channel_scene, read_observations
from services.fit.measurements.surface import held_surface
from services.phantom.jaw import write_jaw_phantom
from services.phantom.object import write_object_phantom
from services.phantom.surface import PhantomSurface
from services.phantom.tooth import write_phantom
from tests.support.prepared import write_prepared


def job(**options: Any) -> JobSpec:
    given: dict[str, Any] = {"capture": Path("capture"), "boundary": "rough"} | options
    return JobSpec(**given)


def test_a_job_that_gives_nothing_has_a_compensated_surface() -> None:
    spec = job()
    assert (spec.roughness, spec.multiple_scattering, spec.ior) == ("fit", "on", 1.631)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"roughness": 0}, 'give "fit", or the GGX roughness of the surface, a number from 0.02 to 1, such as 0.15'),
        ({"roughness": float("nan")}, "the GGX roughness of the surface"),
        ({"roughness": "fitted"}, "the GGX roughness of the surface"),
        ({"roughness": True}, "the GGX roughness of the surface"),
        ({"ior": 1.0}, "ior = 1 is too close to that of air for boundary = rough, which needs at least 1.01"),
        ({"ior": 0.9}, "greater than or equal to 1"),
        ({"kind": "jaw"}, "the roughness of a jaw is not measured; give roughness = 0.15"),
        ({"stains": True}, "has no stains; leave out stains, or choose boundary = thin"),
        ({"multiple_scattering": True}, "'on' or 'off'"),
    ],
)
def test_what_a_rough_surface_cannot_have_is_one_sentence(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(told)):
        job(**options)


def test_a_tooth_has_its_surroundings_and_a_jaw_a_roughness_that_is_given() -> None:
    assert job(surroundings="on").surroundings == "on"
    assert job(kind="jaw", roughness=0.2).roughness == 0.2


def test_others_keep_their_surroundings_and_stains() -> None:
    spec = job(boundary="thin", stains=True, surroundings="on", ior=1.0)
    assert (spec.stains, spec.surroundings) == (True, "on")


def test_the_scene_of_a_fit_has_the_jobs_surface(tmp_path: Path) -> None:
    write_prepared(tmp_path)
    spec = job(dentin="known", roughness=0.3, ior=1.5, multiple_scattering="off")
    observations = read_observations(tmp_path, spec)
    surface = held_surface(spec, observations, tmp_path, print)
    scene = channel_scene(observations, "green", (None,), spec, surface=surface)
    assert (scene.boundary, scene.roughness, scene.ior, scene.multiple_scattering) == ("rough", 0.3, 1.5, False)
    assert surface is not None
    assert {name: one.value for name, one in surface.estimates().items()} == {
        "surface.roughness": 0.3, "surface.ior": 1.5, "surface.multiple_scattering": 0.0,
    }  # fmt: skip
    assert all(one.se is None and not one.determined for one in surface.estimates().values())
    assert held_surface(job(boundary="thin"), observations, tmp_path, print) is None


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (("rough", 1.0), "ior = 1 must lie in 1.01 to 3; correct it, or choose boundary matched."),
        (("rough", 1.5, 0.0), "roughness = 0 must lie in 0.02 to 1; give a GGX roughness such as 0.15."),
    ],
)
def test_a_phantoms_surface_is_possible(values: tuple[Any, ...], told: str) -> None:
    with pytest.raises(InputError, match=re.escape(told)):
        PhantomSurface(*values)


def test_phantoms_refuse_what_a_rough_surface_cannot_have(tmp_path: Path) -> None:
    rough: dict[str, Any] = {"boundary": "rough"}
    with pytest.raises(InputError, match="add --multiple-scattering off, or choose renderer engine"):
        write_object_phantom(tmp_path, renderer="mitsuba", **rough)
    with pytest.raises(InputError, match="add --multiple-scattering off, or choose renderer engine"):
        write_jaw_phantom(tmp_path, renderer="mitsuba", **rough)
    with pytest.raises(InputError, match="A rough surface has no stains; leave them out, or choose boundary thin"):
        write_phantom(tmp_path, stains=True, **rough)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--jaw --roughness 0.3", "Option --roughness is for a rough boundary; add --boundary rough."),
        ("--roughness 0.3", "Option --roughness is for a rough boundary; add --boundary rough."),
        ("--boundary thin --multiple-scattering off", "Option --multiple-scattering is for a rough boundary"),
    ],
)
def test_an_option_that_a_phantom_would_ignore_is_refused(words: str, told: str, tmp_path: Path) -> None:
    refused = CliRunner().invoke(build_app(), ["phantom", "--out", str(tmp_path / "made"), *words.split()])
    assert isinstance(refused.exception, InputError)
    assert told in refused.exception.message
    assert not (tmp_path / "made").exists()


def test_a_highlight_is_as_wide_as_the_surface_is_rough() -> None:
    assert PhantomSurface("rough", roughness=0.4).shine == 0.4
    assert PhantomSurface("thin", roughness=0.4).shine == 0.12
