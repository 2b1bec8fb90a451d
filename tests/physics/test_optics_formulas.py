"""Kernel formulas in single precision compared to NumPy in double precision, up to the limits of their domains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.transport.optics.parameters import Medium
from services.transport.platform import prepare_device
from tests.support.z_scores import LARGEST_Z

G = np.array(
    [0.0, 1e-7, -1e-6, 1e-3, -0.05, 0.3, -0.3, 0.5, -0.7, 0.9, -0.95, 0.99, -0.999, 0.9999, -0.9999], dtype=np.float32
)
"""Mean cosines. In single precision 1 - |g| is exact for |g| >= 0.5, so that values near 1 lose no precision beyond the
rounding of g itself."""
ROUNDING = 6e-8
"""Half a unit in the last place of single precision."""


@pytest.fixture(scope="module", autouse=True)
def _device() -> None:
    prepare_device()


def kernel(function: Callable[..., Any], *columns: NDArray[np.float32]) -> NDArray[np.float64]:
    """Values of a kernel function on broadcast columns."""
    import mitsuba as mi

    shape = np.broadcast_shapes(*(column.shape for column in columns))
    arguments = [
        mi.Float(np.ascontiguousarray(np.broadcast_to(column, shape).ravel(), dtype=np.float32)) for column in columns
    ]
    return np.array(function(*arguments), dtype=np.float64).reshape(shape)


def deviations() -> NDArray[np.float32]:
    """Values of m = 1 - sign(g) cos(theta), from the peak of the narrowest lobe to the opposite direction."""
    return np.concatenate([[0.0], np.logspace(-12, 0, 200), np.linspace(1, 2, 50)]).astype(np.float32)


def density64(g: NDArray[np.float64], m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Henyey-Greenstein value at cos(theta) = sign(g) (1 - m), with 1 + g^2 - 2 |g| (1 - m) expanded about the peak."""
    a = np.abs(g)
    return (1 - a**2) / (4 * np.pi * ((1 - a) ** 2 + 2 * a * m) ** 1.5)


def test_phase_function_values() -> None:
    from services.transport.optics import phase

    g, m = G[:, None], deviations()[None, :]
    # The formula has a dozen roundings, one of them to the power 3/2.
    np.testing.assert_allclose(
        kernel(phase.density, g, m), density64(g.astype(np.float64), m.astype(np.float64)), rtol=20 * ROUNDING
    )


def test_phase_function_derivatives() -> None:
    from services.transport.optics import phase

    g, m = G.astype(np.float64)[:, None], deviations().astype(np.float64)[None, :]
    a, sign = np.abs(g), np.where(g < 0, -1.0, 1.0)
    d = (1 - a) ** 2 + 2 * a * m
    truth = sign * (-2 * a / (1 - a**2) + 3 * ((1 - a) - m) / d)
    ours = kernel(phase.score_g, G[:, None], deviations()[None, :])
    # The score passes through zero, where its terms cancel, so rounding is relative to the terms.
    size = 2 * a / (1 - a**2) + 3 * ((1 - a) + m) / d
    assert (np.abs(ours - truth) <= 20 * ROUNDING * size).all()

    # Compare the formula itself to differences of the log density at a fixed angle; their relative error is 1e-8.
    inner = np.abs(np.float64(G)) < 0.9995
    step = 1e-4 * (1 - a[inner])
    up, down = (
        np.log((1 - h**2) / ((1 - h) ** 2 + 2 * h * m) ** 1.5) * sign[inner] for h in (a[inner] + step, a[inner] - step)
    )
    assert (np.abs((up - down) / (2 * step) - truth[inner]) <= 1e-7 * (size[inner] + 1)).all()


def test_phase_functions_integrate_to_one() -> None:
    from services.transport.optics import phase

    # Integrate by Gauss-Legendre quadrature on panels that shrink towards the peak of the narrowest lobe.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.concatenate([[0.0], np.logspace(-11, np.log10(2), 120)])
    half = np.diff(edges)[:, None] / 2
    m, weight = ((edges[:-1, None] + half) + half * nodes).ravel(), (half * weights).ravel()
    integral = 2 * np.pi * kernel(phase.density, G[:, None], m.astype(np.float32)[None, :]) @ weight
    np.testing.assert_allclose(integral, 1, atol=20 * ROUNDING)


def test_sampled_deviations_invert_the_distribution() -> None:
    from services.transport.optics import phase

    u = np.concatenate([np.linspace(0, 1, 401)[:-1], 1 - np.logspace(-7, -2, 60), np.logspace(-9, -2, 60)]).astype(
        np.float32
    )
    ours = kernel(phase.sample_deviation, G[:, None], u[None, :])
    a, v = np.abs(G.astype(np.float64))[:, None], u.astype(np.float64)[None, :]
    textbook = (1 + a**2 - ((1 - a**2) / (1 - a + 2 * a * v)) ** 2) / (2 * np.maximum(a, 1e-3))
    s = 2 * v - 1
    series = (s + a * (s**2 + 3) / 2 + a**2 * s + a**3 * (s**2 - 1) / 2) / (1 + a * s) ** 2
    truth = 1 - np.where(a < 0.3, series, textbook)
    # The tolerance is relative, also where the lobe is narrow, because the density takes m as its argument. The
    # reference itself computes 1 - cos to 1e-13.
    assert (np.abs(ours - truth) <= 20 * ROUNDING * truth + 1e-13).all()


def test_sampled_directions_have_the_right_moments() -> None:
    import drjit as dr
    import mitsuba as mi

    from services.transport.optics import phase

    count = 1 << 18
    for number, g in enumerate(G):
        rng = mi.PCG32(count, initstate=number)
        omega = dr.normalize(mi.Vector3f(rng.next_float32() - 0.5, rng.next_float32() - 0.5, rng.next_float32() - 0.5))
        turned = phase.deflected(
            omega, mi.Float(g), phase.sample_deviation(mi.Float(g), rng.next_float32()), rng.next_float32()
        )
        before, after = np.array(omega, dtype=np.float64), np.array(turned, dtype=np.float64)
        np.testing.assert_allclose(np.linalg.norm(after, axis=0), 1, atol=1e-6)
        cosine = np.einsum("ij,ij->j", before, after)
        # The first two Legendre moments of a Henyey-Greenstein lobe are g and g^2; |z| <= 4.5 fails one correct run in
        # 5000.
        for sample, truth in ((cosine, g), ((3 * cosine**2 - 1) / 2, g**2)):
            assert abs(sample.mean() - truth) <= LARGEST_Z * sample.std() / np.sqrt(count) + 1e-6
        # The azimuth about omega is uniform.
        side = np.cross(before.T, [0.0, 0.0, 1.0])
        across = np.einsum("ij,ij->i", after.T, side / np.linalg.norm(side, axis=1, keepdims=True))
        assert abs(across.mean()) <= LARGEST_Z * across.std() / np.sqrt(count) + 1e-6


def test_nearly_parallel_directions_stay_apart() -> None:
    from services.transport.optics import phase

    angle = np.logspace(-6, np.log10(3.1), 300)
    along, side = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.0, -0.6])
    before = along.astype(np.float32)
    for g in (0.9, -0.9):
        after = (np.cos(angle)[:, None] * along * np.sign(g) + np.sin(angle)[:, None] * side).astype(np.float32)
        ours = direction_deviation(phase.deviation, g, before, after)
        # Rounding the directions moves them by 1e-7; the chord adds no error of its own.
        assert (np.abs(np.sqrt(2 * ours) - 2 * np.sin(angle / 2)) <= 2e-7).all()


def direction_deviation(
    function: Callable[..., Any], g: float, before: NDArray[np.float32], after: NDArray[np.float32]
) -> NDArray[np.float64]:
    import mitsuba as mi

    return np.array(function(mi.Float(g), mi.Vector3f(before), mi.Vector3f(after.T)), dtype=np.float64)


@pytest.mark.parametrize("eta", [1.0001, 1.33, 1.5, 1.631, 4.0, 1 / 1.33, 1 / 1.631, 0.25])
def test_fresnel_reflectance(eta: float) -> None:
    from services.transport.optics import fresnel

    cosine = np.concatenate([np.logspace(-4, -1, 200), np.linspace(0.1, 1, 500)]).astype(np.float32)
    c, n = cosine.astype(np.float64), np.float64(np.float32(eta))
    inside = np.sqrt(np.maximum(1 - (1 - c**2) / n**2, 0).astype(complex))
    s, p = (c - n * inside) / (c + n * inside), (n * c - inside) / (n * c + inside)
    truth = np.where(1 - c**2 >= n**2, 1.0, 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2))
    ours = kernel(fresnel.reflectance, cosine, np.array([eta], dtype=np.float32))
    # Near the critical angle the transmitted cosine is the root of a rounding error, and enters linearly.
    transmitted_error = np.minimum(
        ROUNDING * 4 / n**2 / np.maximum(inside.real, 1e-12), np.sqrt(ROUNDING * 4) / min(n, 1)
    )
    assert (np.abs(ours - truth) <= 20 * ROUNDING + 8 * max(n, 1 / n) * transmitted_error).all()
    assert ((ours >= 0) & (ours <= 1 + 1e-6)).all()
    assert fresnel_at_normal(ours, cosine) == pytest.approx(((eta - 1) / (eta + 1)) ** 2, abs=1e-7)


def fresnel_at_normal(values: NDArray[np.float64], cosine: NDArray[np.float32]) -> float:
    return float(values[np.argmax(cosine)])


def test_free_flight_functions_do_not_cancel() -> None:
    from services.transport.optics.free_flight import minus_log1m, one_minus_exp

    depth = np.concatenate([[0.0], np.logspace(-20, 2, 600)]).astype(np.float32)
    np.testing.assert_allclose(kernel(one_minus_exp, depth), -np.expm1(-np.float64(depth)), rtol=2e-6)
    chance = np.concatenate([[0.0], np.logspace(-20, -0.001, 600)]).astype(np.float32)
    np.testing.assert_allclose(kernel(minus_log1m, chance), -np.log1p(-np.float64(chance)), rtol=2e-6)


def test_albedos_near_one_keep_their_absorption() -> None:
    import drjit as dr

    from services.transport.scene.media import Media

    # Compute alpha^k as the walk does, for numbers of scattering events k up to where the absorption shows.
    for absorbed in (1e-7, 1e-6, 1e-4, 0.01, 0.5, 0.9):
        (log_alpha,) = Media([Medium(1, 1 - absorbed)]).log_alpha
        count = np.array([1, 10, 1000, 1e5, 1e7])
        lost = 1 - np.array(dr.exp(log_alpha * type(log_alpha)(count.astype(np.float32))), dtype=np.float64)
        np.testing.assert_allclose(lost, -np.expm1(count * np.log1p(-absorbed)), rtol=2e-6, atol=2 * ROUNDING)
