"""Three hundred requests generated from the API's description; ``make contracts`` sends ten thousand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contracts.generated_requests import survey


@pytest.mark.dear("Every operation gets valid and invalid requests; fewer would leave operations without an answer.")
def test_generated_requests_do_no_harm(tmp_path: Path) -> None:
    outcome = survey(tmp_path, 300, 1)
    assert outcome.faults == []
    assert outcome.cases >= 300
    for name, answers in outcome.classes.items():
        assert answers.get("4xx"), name
        assert answers.get("2xx"), name
