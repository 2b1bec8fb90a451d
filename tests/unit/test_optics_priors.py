"""Priors of the fit: the literature's table equals the reference file, the centres are the values a fit of it would
give, and the schedule takes the prior that the job chose.
"""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest

from services.fit.coordinates.domain import HELD_G, similar_medium
from services.fit.coordinates.media import media_domain, shared_domain
from services.fit.coordinates.priors import LITERATURE_TABLE, MIN_SD, WEAK, literature, priors_of, towards
from services.transport.optics.parameters import Medium
from tests.support.shared_data import shared_path


def test_the_table_is_the_references() -> None:
    with (shared_path("reference/tooth_optics.csv")).open() as file:
        rows = [
            row for row in csv.DictReader(file) if row["tissue"] in {"enamel", "dentin"} and row["mu_s_reduced_per_mm"]
        ]
    assert len(rows) == len(LITERATURE_TABLE)
    rows.sort(key=lambda row: row["tissue"] == "dentin")
    for row, ours in zip(rows, LITERATURE_TABLE, strict=True):
        assert (row["tissue"], float(row["wavelength_nm"])) == (ours.tissue, ours.wavelength_nm)
        assert float(row["mu_s_reduced_per_mm"]) == ours.sigma_s_reduced
        assert (float(row["mu_a_per_mm"]) if row["mu_a_per_mm"] else None) == ours.sigma_a
        assert ours.source.split()[0].rstrip(",") in row["source"]


@pytest.mark.parametrize("part", ["enamel", "dentin"])
def test_the_literatures_centre_is_its_geometric_mean(part: str) -> None:
    # sigma at the held mean cosine is sigma_s' / (1 - g) + sigma_a; the prior's centre is the mean of its logarithm
    # over sources.
    rows = [row for row in LITERATURE_TABLE if row.tissue == part]
    given = [row.sigma_a for row in rows if row.sigma_a is not None]
    usual = math.exp(sum(map(math.log, given)) / len(given))
    sigma = [row.sigma_s_reduced / (1 - HELD_G) + (usual if row.sigma_a is None else row.sigma_a) for row in rows]
    mean, sd = literature()[f"{part}.sigma"]
    assert mean == pytest.approx(np.log(sigma).mean(), rel=1e-12)
    assert sd == pytest.approx(np.log(sigma).std(ddof=1), rel=1e-12)


def test_teeth_that_agree_give_no_narrower_a_prior_than_stated() -> None:
    medium = Medium(4.5, 0.997, g1=0.8)
    for media in ([medium], [medium, medium]):
        prior = towards("3.enamel", media)
        mean, sd = prior["3.enamel.sigma"]
        assert mean == pytest.approx(math.log(similar_medium(medium, HELD_G).sigma))
        assert sd == MIN_SD["sigma"]
        assert prior["3.enamel.alpha"][1] == MIN_SD["alpha"]


def test_a_fits_coordinates_carry_the_chosen_prior() -> None:
    means, precision = media_domain(("enamel", "dentin"), ("sigma", "alpha"), priors_of("literature")).prior
    table = literature()
    for k, name in enumerate(("enamel.sigma", "enamel.alpha", "dentin.sigma", "dentin.alpha")):
        assert (means[k], precision[k]) == pytest.approx((table[name][0], table[name][1] ** -2))
    # Weak prior: sigma is free, and a value that both media share keeps the prior that is the same for both. The
    # literature's priors of the two differ, so a shared value has none.
    assert list(media_domain(("enamel",), ("sigma", "alpha")).prior[1]) == [0.0, WEAK["enamel.alpha"][1] ** -2]
    assert list(shared_domain().prior[1]) == [0.0, 1.0]
    assert list(shared_domain(literature()).prior[1]) == [0.0, 0.0]
