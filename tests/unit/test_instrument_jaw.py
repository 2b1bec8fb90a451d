"""The instrument's errors in a jaw: one gain for all teeth, known at least as well as from each tooth alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.core.geometry import Light
from services.core.records import JobSpec
from services.core.results import PreparedManifest
from services.fit.checks.instrument.sentences import instrument_sentences
from services.fit.coordinates.domain import Coordinate, Domain
from services.fit.coordinates.instrument_errors import errors_of
from services.fit.measurements.blocks import BlockInstrument, PixelBlock
from services.fit.measurements.instrument.capture import MAX_JAW_LIGHTS, instrument_of
from services.fit.measurements.instrument.photographs import error_derivatives, photographed
from services.fit.solve.covariance import Uncertainty, uncertainty
from services.fit.solve.elimination import eliminate
from services.fit.solve.estimates import instrument_estimates
from services.fit.solve.normal_equations import NormalEquations, normal_equations
from services.transport.scene.recipe import View
from tests.support.prepared import camera

Array = NDArray[np.float64]

LIGHTS, PIXELS, TEETH, NOISE = ("a", "b"), 30, 3, 0.01
ERRORS = errors_of("green", LIGHTS, ("c0",), None)
TRUE_ERRORS = {"gain.green": 0.02, "light_gain.b": -0.01, "flare.c0.green": 0.002}


def domain_of(teeth: tuple[int, ...]) -> Domain:
    """Unknowns: scattering and absorption of the enamel of these teeth, and the instrument's errors."""
    return Domain(tuple(Coordinate((f"{k}.enamel.{kind}",)) for k in teeth for kind in ("sigma", "alpha")), ERRORS)


def tooth_block(image: Array) -> PixelBlock:
    pixels = np.stack([np.arange(PIXELS)] * 2, axis=-1).astype(np.int32)
    acting = BlockInstrument("gain.green", ("light_gain.a", "light_gain.b"), "flare.c0.green", 1.2)
    shape = image.shape
    view = View(camera("c0"), pixels)
    ones = np.ones(shape)
    return PixelBlock(view, image, NOISE**2 * ones, NOISE**-2 * ones, np.zeros(shape, dtype=bool), instrument=acting)


def equations_of(teeth: tuple[int, ...], domain: Domain, random: np.random.Generator) -> tuple[NormalEquations, Array]:
    """Normal equations at the truth, for teeth whose images depend on two numbers each, and where their minimum is."""
    total, size = None, len(domain.names)
    for place, k in enumerate(teeth):
        own = np.random.default_rng([11, k])
        image, slopes = own.uniform(0.3, 1.2, (len(LIGHTS), PIXELS)), 0.2 * own.standard_normal((2, 2 * PIXELS))
        block = tooth_block(image)
        rows = np.zeros((size, 2 * PIXELS))
        rows[2 * place : 2 * place + 2] = slopes
        rows[domain.tissue_count :] = error_derivatives(image, block, domain.errors.names)
        noise = NOISE * random.standard_normal(2 * PIXELS)
        residual = image.reshape(-1) - photographed(image, block, TRUE_ERRORS).reshape(-1) - noise
        regions = [(range(2 * place, 2 * place + 2), np.ones(2 * PIXELS, dtype=bool))]
        weight = np.full(2 * PIXELS, NOISE**-2)
        one = normal_equations(rows, rows, residual, residual, 1 / weight, weight, 2, regions, len(ERRORS.names))
        total = one if total is None else total + one
    assert total is not None
    step = np.linalg.solve(total.hessian + domain.precision, total.gradient)
    return total, -np.asarray(step, dtype=np.float64)


def solved(teeth: tuple[int, ...]) -> tuple[Uncertainty, Array]:
    domain = domain_of(teeth)
    found, step = equations_of(teeth, domain, np.random.default_rng([5, *teeth]))
    # At the minimum, with the noise as stated, so that no ± becomes larger through residuals that happen to be large.
    there = replace(found, gradient=found.gradient + found.hessian @ step, squares=0.0)
    return uncertainty(domain, step, there), step


def test_teeth_that_share_a_gain_are_known_at_least_as_well_as_alone() -> None:
    together, _ = solved((0, 1, 2))
    whole = np.sqrt(np.diag(together.covariance))
    for k in range(TEETH):
        alone = np.sqrt(np.diag(solved((k,))[0].covariance))
        own, errors = whole[2 * k : 2 * k + 2], whole[2 * TEETH :]
        # More measurements that share unknowns mean less variance, exactly, as derivatives have no noise here.
        assert (own <= alone[:2] * (1 + 1e-9)).all(), (k, own, alone)
        assert (errors <= alone[2:] * (1 + 1e-9)).all(), (k, errors, alone)
        assert own.sum() < 0.99 * alone[:2].sum()


def test_a_gain_that_is_two_percent_off_comes_back_within_its_error() -> None:
    known, _ = solved((0, 1, 2))
    found = instrument_estimates(known)
    for name, true in TRUE_ERRORS.items():
        one = found[name]
        assert one.se is not None
        # The truth is two ± of the prior away from its mean; the bound allows 2 ± for the pull of the prior, and noise.
        assert abs(one.value - true) < 2.5 * one.se, (name, one)
    assert abs(found["gain.green"].value - 0.02) < abs(found["gain.green"].value)


def test_errors_of_the_instrument_eliminated_from_a_jaw_leave_the_marginal_of_the_whole() -> None:
    domain = domain_of((0, 1, 2))
    found, _ = equations_of((0, 1, 2), domain, np.random.default_rng(1))
    left = eliminate(found, domain.precision, np.zeros(len(domain.names)), domain.tissue_count)
    marginal = np.linalg.inv(found.hessian + domain.precision)[: domain.tissue_count, : domain.tissue_count]
    np.testing.assert_allclose(np.linalg.inv(left.hessian), marginal, rtol=1e-8)


def manifest(lights: int) -> PreparedManifest:
    rig = tuple(Light(name=f"l{k}", position_mm=(float(k), 500.0, 300.0), intensity=(1e6,)) for k in range(lights))
    return PreparedManifest(
        channels=("green",), cameras=(camera("c0"),), lights=rig, held_out=(), fdi=(11, 12),
        dentin_known=(), median_motion_px=None, valid_fraction=0.9,
    )  # fmt: skip


def test_a_jaw_under_many_lights_knows_their_common_gain_alone_and_says_so() -> None:
    spec = JobSpec.model_validate({"kind": "jaw", "capture": "c"})
    for count, told in ((MAX_JAW_LIGHTS, False), (MAX_JAW_LIGHTS + 1, True)):
        instrument = instrument_of(manifest(count), spec, np.zeros(3))
        assert instrument is not None
        errors = instrument.errors("green", ("c0",), np.ones(count, dtype=bool))
        assert ("light_gain.l0" in errors.names) is not told
        assert {"gain.green", "flare.c0.green"} <= set(errors.names)
        said = " ".join(instrument_sentences(spec, {"green": errors}, {}, ()))
        assert ("single lights for as bright" in said) is told
    tooth = instrument_of(manifest(count), spec.model_copy(update={"kind": "tooth"}), np.zeros(3))
    assert tooth is not None
    assert len(tooth.errors("green", ("c0",), np.ones(count, dtype=bool)).names) == count + 2 + 6
    assert instrument_of(manifest(2), spec.model_copy(update={"instrument": "off"}), np.zeros(3)) is None
