"""Random numbers by counter: a stream is a 64-bit state that follows from seed, block and path (SplitMix64)."""

from __future__ import annotations

import numpy as np
from numba import njit

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FIRST_MIX = np.uint64(0xBF58476D1CE4E5B9)
SECOND_MIX = np.uint64(0x94D049BB133111EB)
TO_UNIT = 2.0**-53


def block_key(*numbers: int) -> np.uint64:
    """Key of a block of paths from the numbers that identify it."""
    return np.uint64(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0])


@njit(cache=True, inline="always")
def splitmix64(state):  # type: ignore[no-untyped-def]  # compiled
    """SplitMix64's output function, a bijection of 64-bit words."""
    z = (state ^ (state >> np.uint64(30))) * FIRST_MIX
    z = (z ^ (z >> np.uint64(27))) * SECOND_MIX
    return z ^ (z >> np.uint64(31))


@njit(cache=True, inline="always")
def path_state(key, path):  # type: ignore[no-untyped-def]  # compiled
    """State at which a path's stream starts."""
    return splitmix64(key + splitmix64(np.uint64(path) + GOLDEN))


@njit(cache=True, inline="always")
def uniform(state):  # type: ignore[no-untyped-def]  # compiled
    """The next number in (0, 1) and the state after it."""
    state = state + GOLDEN
    return (np.float64(splitmix64(state) >> np.uint64(11)) + 0.5) * TO_UNIT, state
