"""Rate limits of requests: moving windows in the memory of this process."""

from __future__ import annotations

import ipaddress
import math
import time
from collections import deque

from services.core.settings import RateSettings


class MovingWindow:
    """Grants each key at most ``most`` hits within any period of ``seconds``."""

    def __init__(self, most: int, seconds: float) -> None:
        self._most, self._seconds = most, seconds
        self._hits: dict[str, deque[float]] = {}
        self._sweep_at = 0.0

    def hit(self, key: str) -> int:
        """Count a hit and return 0, or return after how many seconds the next hit is granted."""
        now = time.monotonic()
        if now >= self._sweep_at:
            self._hits = {one: hits for one, hits in self._hits.items() if hits[-1] > now - self._seconds}
            self._sweep_at = now + self._seconds
        hits = self._hits.setdefault(key, deque())
        while hits and hits[0] <= now - self._seconds:
            hits.popleft()
        if len(hits) >= self._most:
            return max(1, math.ceil(hits[0] + self._seconds - now))
        hits.append(now)
        return 0


class RateLimits:
    """Counts requests. The methods that count return how many seconds to wait, 0 where the request may go on.

    All methods are to be called from the same thread.
    """

    def __init__(self, settings: RateSettings) -> None:
        self._reads = MovingWindow(settings.reads_per_10_s, 10.0)
        self._writes = MovingWindow(settings.writes_per_10_s, 10.0)
        self._refusals = MovingWindow(settings.refusals_per_minute, 60.0)
        self._audited_refusals = MovingWindow(1, 60.0)

    def count(self, caller: str, *, is_change: bool) -> int:
        """Count a request of a token or, without one, of an address."""
        return (self._writes if is_change else self._reads).hit(caller)

    def count_refusal(self, address: str) -> int:
        """Count a request without a valid token."""
        return self._refusals.hit(address)

    def should_audit_refusal(self, address: str) -> bool:
        """Whether a refusal of this address is to be audited; true once a minute."""
        return self._audited_refusals.hit(address) == 0


def network_of(address: str) -> str:
    """Return the network that counts as one address. An IPv6 host owns a /64 network and may use any address in it."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network(f"{ip}/64", strict=False)) if ip.version == 6 else str(ip)
