"""Parts of a jaw's fit: starting values, neighbours along the arch, the reflectance of the mouth's wall, and the
parameters of a mouth.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from services.anatomy.distance import SurfaceDistance
from services.anatomy.job_dentin import jaw_dentins
from services.anatomy.templates.crown import build_tooth
from services.anatomy.templates.dimensions import upper_tooth
from services.core.errors import CaptureInputError, InputError, JobCancelledError, MeshError
from services.core.geometry import Mesh, Tooth
from services.core.records import JobSpec
from services.fit.coordinates.domain import Coordinate, Domain, kind_of, similar_tissue
from services.fit.coordinates.priors import SHAPE
from services.fit.passes.final_uncertainty import _with_cosine
from services.fit.passes.neighbours import Neighbours, arch_position
from services.fit.stages.jaw.schedule import JawSchedule
from services.fit.stages.jaw.starts import MIN_TOOTH_PIXELS, ToothStart, median_tissue, start_mouth, start_tooth
from services.phantom.dome_rig import dome_cameras
from services.transport.optics.half_space import half_space_reflectance
from services.transport.optics.parameters import Medium, Mouth, Tissue


def tissue(sigma: float, alpha: float = 0.99) -> Tissue:
    return Tissue(Medium(sigma, alpha, g1=0.8), Medium(2 * sigma, alpha, g1=0.8))


def fitted(fdi: int, own: Tissue) -> ToothStart:
    return ToothStart(fdi, "fitted", "", 100, own)


def test_the_wall_reflects_like_an_isotropic_half_space() -> None:
    # Spherical albedo from Chandrasekhar's H function, itself by iterating its integral equation at 60 Gauss points
    # (within 1e-11 of those at 200).
    nodes, weights = np.polynomial.legendre.leggauss(60)
    mu, weights = (nodes + 1) / 2, weights / 2
    for albedo in (0.05, 0.5, 0.9, 0.99, 0.999):
        h = np.ones_like(mu)
        for _ in range(500):
            h = 1 / (math.sqrt(1 - albedo) + 0.5 * albedo * ((weights * mu * h) / (mu[:, None] + mu)).sum(axis=1))
        exact = 1 - 2 * math.sqrt(1 - albedo) * float((weights * mu * h).sum())
        # The fit's own error is at most 0.0021; similarity is exact for what is isotropic.
        assert half_space_reflectance(Medium(3.0, albedo)) == pytest.approx(exact, abs=0.0022)
    forward = Medium(10.0, 0.99, g1=0.9)
    assert half_space_reflectance(forward) == pytest.approx(
        half_space_reflectance(Medium(1.0, forward.alpha_reduced)), rel=1e-12
    )


def test_hidden_teeth_are_tied_and_faults_of_their_own_are_told() -> None:
    def broken() -> Tissue:
        raise MeshError("Its dentin sticks out; repair it.")

    hidden = start_tooth(17, MIN_TOOTH_PIXELS - 1, broken)
    assert (hidden.state, hidden.tissue, hidden.drops_dentin) == ("tied", None, False)
    failed = start_tooth(11, MIN_TOOTH_PIXELS, broken)
    assert (failed.state, failed.drops_dentin) == ("failed", True)
    assert "Its dentin sticks out" in failed.sentence

    def dark() -> Tissue:
        raise CaptureInputError("Tooth 11 is dark; light it.")

    assert not start_tooth(11, 100, dark).drops_dentin

    def cancelled() -> Tissue:
        raise JobCancelledError("Cancelled.")

    with pytest.raises(JobCancelledError):
        start_tooth(11, 100, cancelled)


def test_others_follow_the_median_of_the_front_teeth() -> None:
    starts = [
        fitted(11, tissue(2.0)),
        fitted(12, tissue(8.0)),
        fitted(16, tissue(100.0)),
        ToothStart(17, "tied", "Hidden.", 0, None),
    ]
    mouth = start_mouth(starts, Medium(8.0, 0.96, g1=0.8), has_cavity=True)
    # The median of two in ln sigma; the molar does not count.
    assert mouth.teeth[3].enamel.sigma == pytest.approx(4.0)
    assert mouth.teeth[2].enamel.sigma == pytest.approx(100.0)
    assert mouth.reflectance == pytest.approx(half_space_reflectance(Medium(8.0, 0.96, g1=0.8)))
    assert median_tissue([starts[2]], [tissue(5.0)]).enamel.sigma == pytest.approx(5.0)
    # Whatever their cosines, the value for the other teeth has the same reduced scattering and absorption.
    turned = similar_tissue(tissue(5.0), 0.5)
    for part in ("enamel", "dentin"):
        other, own = median_tissue([starts[2]], [turned]).medium(part), turned.medium(part)
        assert (other.g1, other.sigma_s_reduced, other.alpha_reduced) == pytest.approx(
            (0.8, own.sigma_s_reduced, own.alpha_reduced)
        )
    with pytest.raises(InputError, match=r"No tooth of the jaw can be fitted.*Hidden"):
        start_mouth([starts[3]], None, has_cavity=False)


def test_neighbours_are_those_along_the_arch() -> None:
    assert sorted((11, 17, 21, 27, 12), key=arch_position) == [17, 12, 11, 21, 27]
    assert sorted((31, 41, 48, 38), key=arch_position) == [48, 41, 31, 38]
    assert sorted((51, 61, 71, 81), key=arch_position) == [51, 81, 61, 71]
    names = [f"{k}.enamel.sigma" for k in range(4)] + ["gums.sigma", "cavity.reflectance"]
    domain = Domain(tuple(Coordinate((name,)) for name in names))
    # Teeth 11, 12, 21, 22 in a manifest's order stand as 12, 11, 21, 22.
    assert Neighbours.of((11, 12, 21, 22)).near(domain) == (
        (0, 1, 2, 4, 5),
        (0, 1, 4, 5),
        (0, 2, 3, 4, 5),
        (2, 3, 4, 5),
    )
    # The jaws are treated separately: 11 is between 12 and 21, whatever bites on it.
    both = (12, 11, 21, 42, 41, 31)
    assert [both[k] for k in Neighbours.of(both).beside(both.index(11))] == [12, 11, 21]


def test_a_mouth_has_coordinates_like_a_tooth() -> None:
    mouth = Mouth((tissue(2.0), tissue(3.0)), Medium(8.0, 0.96, g1=0.8), 0.3)
    domain = Domain(tuple(Coordinate((name,)) for name in ("1.dentin.sigma", "gums.alpha", "cavity.reflectance")))
    x = domain.x_of(mouth)
    np.testing.assert_allclose(x, [math.log(6.0), -math.log10(0.04), math.log(0.3 / 0.7)])
    moved = domain.tissue_at(x + np.array([math.log(2), 1.0, 0.0]), mouth)
    assert (moved.teeth[1].dentin.sigma, moved.value("gums.alpha"), moved.reflectance) == pytest.approx(
        (12.0, 0.996, 0.3)
    )
    assert moved.teeth[0] == mouth.teeth[0]
    assert [kind_of(name) for name in ("3.shape.1", "0.enamel.g1", "cavity.reflectance")] == [
        "shape",
        "g1",
        "reflectance",
    ]
    similar = similar_tissue(mouth, 0.0)
    assert similar.reflectance == mouth.reflectance
    for part in ("0.enamel", "1.dentin", "gums"):
        assert similar.medium(part).sigma_s_reduced == pytest.approx(mouth.medium(part).sigma_s_reduced)
        assert similar.medium(part).mean_cosine == 0.0


def test_coordinates_of_one_tooth_are_related() -> None:
    domain = Domain(
        tuple(
            Coordinate((name,))
            for name in ("0.enamel.sigma", "0.dentin.alpha", "11.enamel.sigma", "gums.sigma", "cavity.reflectance")
        )
    )
    assert domain.relation.tolist() == [
        [0, 0, 2, 1, 1],
        [0, 0, 2, 1, 1],
        [2, 2, 0, 1, 1],
        [1, 1, 1, 1, 1],
        [1, 1, 1, 1, 1],
    ]
    alone = Domain((Coordinate(("enamel.sigma", "dentin.sigma")), Coordinate(("shape.0",))))
    assert not alone.relation.any()


def test_media_of_one_tissue_take_another_mean_cosine_together() -> None:
    mouth = Mouth((tissue(2.0), tissue(3.0)), Medium(8.0, 0.96, g1=0.8), 0.3)
    moved = _with_cosine(mouth, ("0.enamel", "1.enamel", "gums"), math.atanh(0.6))
    for part in ("0.enamel", "1.enamel", "gums"):
        assert moved.medium(part).mean_cosine == pytest.approx(0.6)
        for leaf in ("sigma_s_reduced", "alpha_reduced"):
            assert getattr(moved.medium(part), leaf) == pytest.approx(getattr(mouth.medium(part), leaf))
    assert [tooth.dentin for tooth in moved.teeth] == [tooth.dentin for tooth in mouth.teeth]
    assert moved.reflectance == mouth.reflectance


def test_a_molars_dentin_lies_as_its_cusps_do_whatever_the_cameras_see() -> None:
    # A molar between a front camera and the cheek, next to a plate that is too thin for dentin.
    solid = build_tooth(upper_tooth(6))
    plate = trimesh.creation.box(extents=(7.0, 0.15, 8.0)).subdivide().subdivide()
    thin = Mesh(np.asarray(plate.vertices) + np.array([7.5, 0.0, 0.0]), np.asarray(plate.faces, dtype=np.int32))
    (camera,) = dome_cameras(1, 2.0, (solid.outer,))
    teeth, spec = (
        (Tooth(16, solid.outer), Tooth(15, thin)),
        JobSpec.model_validate({"capture": "c", "kind": "jaw", "dentin": "fit"}),
    )
    molar, other = jaw_dentins(teeth, (camera,), spec)
    assert other is None
    assert molar is not None
    dentin = Mesh(molar.vertices_mm((SHAPE[0],) * 3), molar.base.faces)
    height = solid.outer.vertices_mm[:, 2]
    points = solid.outer.vertices_mm[height > height.max() - upper_tooth(6).crown_length_mm / 2][::7]
    found, true = (SurfaceDistance(surface).closest(points)[1] for surface in (dentin, solid.dentin))
    # At weights that were not fitted: 0.13 was measured with the true frame, 0.7 to 0.9 with a frame that lies on its
    # side.
    assert np.abs(found - true).mean() < 0.2

    assert jaw_dentins(teeth, (camera,), spec.model_copy(update={"dentin": "none"})) == [None, None]


def test_steps_of_a_jaw_are_told_by_fdi_numbers_and_not_by_places_in_a_list() -> None:
    schedule = object.__new__(JawSchedule)
    schedule.teeth = [ToothStart(fdi, "fitted", "", 100, tissue(4.0)) for fdi in (21, 12)]
    names = ("0.enamel.sigma", "1.shape.0", "gums.sigma", "cavity.reflectance")
    assert [schedule._reported_name(name) for name in names] == [
        "21.enamel.sigma",
        "12.shape.0",
        "gums.sigma",
        "cavity.reflectance",
    ]
