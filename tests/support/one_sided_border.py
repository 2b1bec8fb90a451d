"""The walk with the border derivative of the teeth paper of 2018: the moving border changes transmittance (Eq. 32) but
not scattering.
"""

from __future__ import annotations

from typing import Any

import pytest

from services.transport.platform import prepare_device


def leave_out_scattering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the scattering term out of every border derivative for the rest of the test."""
    prepare_device()
    from services.transport.paths import walk

    class WithoutScattering(walk.Walk):
        def _start_secondary(self, walker: Any, ended: Any, tally: Any) -> Any:  # noqa: ARG002
            return ended

    monkeypatch.setattr(walk, "Walk", WithoutScattering)
