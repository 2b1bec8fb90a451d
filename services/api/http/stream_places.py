"""How many event streams a token, and an address, may hold open at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from services.api.http.rate_limits import network_of
from services.client.errors import RateError

if TYPE_CHECKING:
    from starlette.types import Scope

    from services.core.settings import ConnectionLimits


class StreamPlaces:
    """The open streams. All methods are to be called from the same thread."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self._limits = limits
        self._open: Counter[str] = Counter()

    @contextmanager
    def taken(self, scope: Scope) -> Iterator[None]:
        """Take a place for one request as long as the block lasts.

        Raises:
            RateError: its token, or its address, holds as many streams as it may.
        """
        caller, address = scope.get("caller"), scope["client"][0] if scope.get("client") else "unknown"
        holders = [(f"address {network_of(address)}", self._limits.streams_per_address)]
        if caller is not None and caller.token is not None:
            holders.append((f"token {caller.token.id}", self._limits.streams_per_token))
        for holder, most in holders:
            if self._open[holder] >= most:
                raise RateError(
                    f"The {holder} holds {most} event streams open, which is the limit; close one, or follow several"
                    " jobs in one stream with GET /v1/events."
                )
        self._open.update(holder for holder, _ in holders)
        try:
            yield
        finally:
            self._open.subtract(holder for holder, _ in holders)
            self._open += Counter()  # forget those who hold none
