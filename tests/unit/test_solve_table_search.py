"""The table search, on images that are polynomials in the albedo by construction."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from services.fit.solve.table_search import Node, Observed, best, bin_powers, nodes, order_edges, search_node

EDGES = order_edges()
NODE = Node(5.0, 0.7)


def _orders(rng: np.random.Generator, measurements: int = 60) -> np.ndarray:
    # Each measurement has its own distribution of orders, as pixels and lights do.
    depth = rng.uniform(3, 80, measurements)
    n = 0.5 * (EDGES[:-1] + EDGES[1:] - 1)[:, None]
    shares = np.exp(-n / depth) * np.diff(EDGES)[:, None] / depth
    return (rng.uniform(0.5, 1.5, measurements) * shares)[:, None, :]


def _observed(image: np.ndarray) -> Observed:
    flat = image.reshape(-1)
    return Observed(flat, np.zeros_like(flat), np.ones_like(flat))


def test_bins_cover_every_order_once_and_stay_narrow() -> None:
    assert EDGES[0] == 0
    assert (np.diff(EDGES) > 0).all()
    wide = EDGES[1:][EDGES[1:] > 9] / EDGES[:-1][EDGES[1:] > 9]
    assert wide.max() <= 1.25


def test_bin_powers_are_the_means_of_the_powers() -> None:
    alpha = np.array([0.3, 0.9, 0.999, 1.0])
    exact = [[np.mean(a ** np.arange(first, last)) for first, last in pairwise(EDGES)] for a in alpha]
    np.testing.assert_allclose(bin_powers(alpha, EDGES), exact, rtol=1e-10)


def test_finds_the_albedo_and_scale_it_was_given() -> None:
    orders = _orders(np.random.default_rng(1))
    for alpha, scale in ((0.93, 1.0), (0.99, 1.2), (0.997, 0.9)):
        image = scale * np.einsum("k,kln->ln", bin_powers(np.array([alpha]), EDGES)[0], orders)
        found = search_node(NODE, [(orders, orders)], EDGES, [_observed(image)], 3000)
        # 3000 albedos over two decades of 1 - alpha: neighbours differ by 0.15 % of 1 - alpha; the choice by error
        # must not depend on the scale.
        closest = min(found, key=lambda c: c.error)
        assert abs(np.log((1 - closest.alpha) / (1 - alpha))) < 0.05
        assert abs(closest.scale / scale - 1) < 0.01
        assert closest.error < 1e-3


def test_independent_seeds_keep_noise_out_of_the_error() -> None:
    rng = np.random.default_rng(2)
    orders = _orders(rng, 4000)
    image = np.einsum("k,kln->ln", bin_powers(np.array([0.99]), EDGES)[0], orders)
    first, second = (orders * (1 + 2.0 * rng.standard_normal(orders.shape)) for _ in range(2))
    found = search_node(NODE, [(first, second)], EDGES, [_observed(image)], 500)[0]
    # The noise of a pixel is 50 % here; a single seed would give an error of about 0.4.
    assert found.error < 0.1


def test_black_render_explains_nothing() -> None:
    orders = np.zeros((len(EDGES) - 1, 1, 5))
    found = search_node(NODE, [(orders, orders)], EDGES, [_observed(np.ones((1, 5)))], 10)
    assert all(c.error == 1 and c.scale == 0 and c.score == np.inf for c in found)


def test_best_takes_one_per_node_in_order() -> None:
    rng = np.random.default_rng(3)
    orders = _orders(rng)
    image = _observed(np.einsum("k,kln->ln", bin_powers(np.array([0.99]), EDGES)[0], orders))
    per_node = [search_node(node, [(orders, orders)], EDGES, [image], 50) for node in nodes()[:4]]
    ranked = best(per_node)
    assert len(ranked) == 3
    assert [c.score for c in ranked] == sorted(c.score for c in ranked)
