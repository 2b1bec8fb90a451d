"""A server that requires tokens."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from services.core.settings import RateSettings
from tests.support.access_requests import write_report
from tests.support.guarded_server import Guarded, guarded


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    # Allow more refusals than a test of every route makes; the limit itself is tested elsewhere.
    with guarded(tmp_path_factory.mktemp("data"), write_report, rates=RateSettings(refusals_per_minute=1000)) as server:
        yield server
