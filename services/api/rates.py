"""How often a caller may ask: moving windows in this process's memory."""

from __future__ import annotations

import ipaddress
import math
import time
from typing import TYPE_CHECKING

from services.core.settings import RateSettings

if TYPE_CHECKING:
    from limits import RateLimitItem


class Rates:
    """Counts requests; every method answers how many seconds to wait, 0 where the request may go on."""

    def __init__(self, settings: RateSettings) -> None:
        from limits import RateLimitItemPerMinute, RateLimitItemPerSecond
        from limits.storage import MemoryStorage
        from limits.strategies import MovingWindowRateLimiter

        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._reads = RateLimitItemPerSecond(settings.reads_per_10_s, 10, "reads")
        self._writes = RateLimitItemPerSecond(settings.writes_per_10_s, 10, "writes")
        self._refusals = RateLimitItemPerMinute(settings.refusals_per_minute, 1, "refusals")
        self._tellings = RateLimitItemPerMinute(1, 1, "tellings")

    def count(self, caller: str, *, is_change: bool) -> int:
        """Count a request of a token or an address."""
        return self._hit(self._writes if is_change else self._reads, caller)

    def count_refusal(self, address: str) -> int:
        """Count a request without a valid token."""
        return self._hit(self._refusals, address)

    def is_worth_telling(self, address: str) -> bool:
        """True once a minute for an address."""
        return self._hit(self._tellings, address) == 0

    def _hit(self, item: RateLimitItem, key: str) -> int:
        if self._limiter.hit(item, key):
            return 0
        return max(1, math.ceil(self._limiter.get_window_stats(item, key).reset_time - time.time()))


def network_of(address: str) -> str:
    """What is counted as one address: an IPv6 host owns a /64 and may use any of it."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network(f"{ip}/64", strict=False)) if ip.version == 6 else str(ip)
