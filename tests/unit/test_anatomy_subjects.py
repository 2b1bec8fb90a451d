"""Random subjects are repeatable, stay within the spread they are drawn from, and have yellow teeth."""

from __future__ import annotations

import pytest

from services.phantom.subjects import DENTIN, ENAMEL, subject_tissues

CHANNELS = ("red", "green", "blue")


@pytest.mark.parametrize("seed", range(20))
def test_subject_is_within_its_spread(seed: int) -> None:
    tissue = subject_tissues(seed, ("green",))["green"]
    for medium, spread in ((tissue.enamel, ENAMEL), (tissue.dentin, DENTIN)):
        absorption = (1 - medium.alpha) * medium.sigma
        for value, (least, most) in (
            (medium.sigma_s_reduced, spread.sigma_s_reduced),
            (absorption, spread.sigma_a),
            (medium.g1, spread.g1),
        ):
            assert least * (1 - 1e-9) <= value <= most * (1 + 1e-9)


def test_same_seed_gives_the_same_subject() -> None:
    assert subject_tissues(7, CHANNELS) == subject_tissues(7, CHANNELS)
    assert (
        subject_tissues(7, ("green",))["green"]
        == subject_tissues(7, CHANNELS)["green"]
        != subject_tissues(8, CHANNELS)["green"]
    )


def test_absorption_rises_towards_blue() -> None:
    tissues = subject_tissues(3, CHANNELS)
    for part in ("enamel", "dentin"):
        absorptions = [(1 - getattr(tissues[c], part).alpha) * getattr(tissues[c], part).sigma for c in CHANNELS]
        assert absorptions == sorted(absorptions)
