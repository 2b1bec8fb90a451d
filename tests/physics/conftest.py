"""Tests of this folder trace paths on one thread: on small images, several threads would mostly wait for one another
beside the other processes of the run. ``test_engine_repeats`` compares numbers of threads in a process of its own.
"""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    from services.fit.transport.platform import prepare_device

    prepare_device()
    import drjit as dr

    dr.set_thread_count(1)
