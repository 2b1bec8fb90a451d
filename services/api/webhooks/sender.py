"""Sends due deliveries to webhooks, signed as Standard Webhooks says: one message at a time to each receiver, to many
receivers at once.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import logging
import random
import ssl
import time
from collections.abc import Callable
from importlib.metadata import version

import httpx
import sqlalchemy as sql

from services.api.http.awaited_threads import in_thread
from services.api.webhooks.address import AddressPolicy
from services.api.webhooks.deliveries import Attempt, Claim, Deliveries
from services.api.webhooks.webhooks import KEY_PREFIX
from services.client.errors import WebhookAddressError

PERIOD_S = 0.5
"""Time in s between two looks for due deliveries."""
MAX_AT_ONCE = 16
"""Largest number of receivers that are served at once."""
CONNECT_S = 5.0
"""Longest time in s that connecting to a receiver may take."""
TOTAL_S = 10.0
"""Longest time in s from resolving the name to the head of the answer; well below the time for which a delivery is
claimed."""
FIRST_RETRY_S = 10.0
"""Mean time in s between the first attempt and the second."""


def sign(secret: str, message: str, timestamp: int, payload: str) -> str:
    """Return the value of the header ``webhook-signature``."""
    key = base64.b64decode(secret.removeprefix(KEY_PREFIX))
    digest = hmac.digest(key, f"{message}.{timestamp}.{payload}".encode(), hashlib.sha256)
    return f"v1,{base64.b64encode(digest).decode()}"


def retry_s(tries: int, draw: float) -> float:
    """Return the time in s to wait after so many attempts: doubling from 10 s, and varied by ``draw`` in [0, 1) to
    between half and one and a half times that.
    """
    return float(FIRST_RETRY_S * 2.0 ** (tries - 1) * (0.5 + draw))


class WebhookSender:
    """Sends while ``run`` runs.

    Args:
        clock: returns Unix time in s, by which deliveries fall due.
        draw: returns a random number, uniform in [0, 1), that varies the waiting times.
        tls: TLS context with the trusted authorities; None for the usual ones.
    """

    def __init__(
        self,
        deliveries: Deliveries,
        policy: AddressPolicy,
        period_s: float = PERIOD_S,
        total_s: float = TOTAL_S,
        clock: Callable[[], float] = time.time,
        draw: Callable[[], float] = random.random,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._deliveries, self._policy = deliveries, policy
        self._period_s, self._total_s, self._clock, self._draw = period_s, total_s, clock, draw
        self._tls = tls

    async def run(self) -> None:
        """Send until cancelled. A delivery that is on its way then falls due again when its claim ends."""
        sending: dict[str, asyncio.Task[None]] = {}
        limits = httpx.Limits(
            max_keepalive_connections=0
        )  # a kept connection to one host would serve another at the same address
        timeout, verify = (
            httpx.Timeout(self._total_s, connect=CONNECT_S),
            self._tls or httpx.create_ssl_context(trust_env=False),
        )
        async with httpx.AsyncClient(
            verify=verify, trust_env=False, follow_redirects=False, timeout=timeout, limits=limits
        ) as http:
            try:
                while True:
                    sending = {webhook: task for webhook, task in sending.items() if not task.done()}
                    try:
                        await in_thread(self._deliveries.collect, self._clock())
                        most = MAX_AT_ONCE - len(sending)
                        for claim in (
                            await in_thread(self._deliveries.claim, self._clock(), tuple(sending), most) if most else ()
                        ):
                            sending[claim.webhook] = asyncio.create_task(self._deliver(http, claim))
                    except sql.exc.SQLAlchemyError as problem:
                        logging.getLogger(__name__).warning(
                            "Webhooks wait for the database: %s", problem.__class__.__name__
                        )
                    await asyncio.sleep(self._period_s)
            finally:
                for task in sending.values():
                    task.cancel()
                await asyncio.gather(*sending.values(), return_exceptions=True)

    async def _deliver(self, http: httpx.AsyncClient, claim: Claim) -> None:
        started_s, started = self._clock(), time.monotonic()
        status, error = None, None
        try:
            async with asyncio.timeout(self._total_s):
                status = await self._post(http, claim)
            error = _complaint(status)
        except TimeoutError:
            error = f"The receiver did not answer within {self._total_s:g} s."
        except WebhookAddressError as problem:
            error = problem.message
        except httpx.HTTPError as problem:
            error = f"The receiver could not be reached ({type(problem).__name__})."
        attempt = Attempt(time_s=started_s, duration_s=time.monotonic() - started, status=status, error=error)
        wait_s = retry_s(claim.tries + 1, self._draw())
        try:
            await in_thread(self._deliveries.settle, claim, attempt, wait_s, is_gone=status == 410)
        except sql.exc.SQLAlchemyError as problem:
            logging.getLogger(__name__).warning(
                "A webhook's delivery could not be logged: %s", type(problem).__name__, extra={"webhook": claim.webhook}
            )

    async def _post(self, http: httpx.AsyncClient, claim: Claim) -> int:
        """Post a message and return the status of the answer, whose body is not read. The connection goes to a checked
        address, under the name that the certificate must prove.
        """
        url, timestamp = httpx.URL(claim.url), int(self._clock())
        host = url.raw_host.decode()
        port = url.port or (443 if url.scheme == "https" else 80)
        headers = {
            "Host": url.netloc.decode(),
            "Content-Type": "application/json",
            "User-Agent": f"dentine/{version('dentine')}",
            "webhook-id": claim.message,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": sign(claim.secret, claim.message, timestamp, claim.payload),
        }
        unreached = httpx.ConnectError("no address")
        for address in await self._policy.resolve(host, port, url.scheme):
            request = http.build_request(
                "POST",
                url.copy_with(host=address),
                content=claim.payload,
                headers=headers,
                extensions={"sni_hostname": host},
            )
            try:
                response = await http.send(request, stream=True)
            except (httpx.ConnectError, httpx.ConnectTimeout) as problem:
                unreached = httpx.ConnectError(str(problem))
                continue
            await response.aclose()
            return response.status_code
        raise unreached


def _complaint(status: int) -> str | None:
    if 200 <= status < 300:
        return None
    return f"The receiver answered {status}" + ("; redirects are not followed." if 300 <= status < 400 else ".")
