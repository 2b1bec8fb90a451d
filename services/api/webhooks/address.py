"""Checks the addresses of webhooks: a name is resolved first, its addresses are checked, and only those are connected
to.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import httpx

from services.client.errors import WebhookAddressError

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address

_HOST = re.compile(r"[A-Za-z0-9_.:-]+")
_ASKERS = ThreadPoolExecutor(16, "names")
"""Threads that ask name servers, as many as receivers are served at once; nothing else waits for a name server that
does not answer."""
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")
"""Network of IPv6 addresses whose last 32 bits are the IPv4 address to which they are translated (RFC 6052)."""
_EXAMPLES = ipaddress.IPv6Network("3fff::/20")
"""Network for documentation (RFC 9637), which Python 3.12 takes for public."""
_ISATAP = frozenset({0x0000_5EFE, 0x0200_5EFE})
"""Values of the first 32 of the last 64 bits of an IPv6 address which say that an IPv4 address follows, to which
packets are tunnelled (RFC 5214)."""


@dataclass(frozen=True)
class AddressPolicy:
    """The addresses to which webhooks may go. ``allow_private`` allows private, link-local and loopback addresses, and
    plain http to those.
    """

    allow_private: bool = False

    def check_url(self, url: str) -> None:
        """Check what can be known without asking a name server.

        Raises:
            WebhookAddressError: the URL is not a web address, is not https, contains a login or a fragment, or names a
                forbidden address.
        """
        try:
            parts = httpx.URL(url)
            host = parts.raw_host.decode()
        except (httpx.InvalidURL, ValueError) as problem:
            raise WebhookAddressError(
                f"The webhook's address is malformed ({problem}); give one such as https://example.org/hook."
            ) from problem
        if parts.scheme not in {"https", "http"} or not _HOST.fullmatch(host) or not 0 < (parts.port or 443) < 2**16:
            raise WebhookAddressError(
                "The webhook's address must be an absolute https address, such as https://example.org/hook."
            )
        if parts.userinfo or parts.fragment:
            raise WebhookAddressError(
                "The webhook's address must not hold a login or a fragment; the signature tells the receiver who sends."
            )
        if parts.scheme == "http" and not self.allow_private:
            raise WebhookAddressError("The webhook's address must be https.")
        if (literal := _literal(host)) is not None:
            self.check_address(literal, parts.scheme)

    def check_address(self, address: IpAddress, scheme: str) -> None:
        """Check an address before it is connected to.

        Raises:
            WebhookAddressError: the address is not public and the settings do not allow that, or plain http would go to
                a public one.
        """
        if not is_public(address):
            if not self.allow_private or address.is_multicast or address.is_unspecified:
                raise WebhookAddressError(
                    f"Webhooks may not go to {address}, which is no public address; set private_webhooks to allow"
                    " private ones."
                )
        elif scheme == "http":
            raise WebhookAddressError(f"A webhook to the public address {address} must be https.")

    async def resolve(self, host: str, port: int, scheme: str) -> list[str]:
        """Resolve a host and check all its addresses.

        Raises:
            WebhookAddressError: one of them is refused, or the name has none.
        """
        try:
            ask = partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
            found = await asyncio.get_running_loop().run_in_executor(_ASKERS, ask)
        except (OSError, UnicodeError) as problem:
            raise WebhookAddressError(
                f"The webhook's host {host} cannot be resolved; correct the address."
            ) from problem
        addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))
        for address in addresses:
            self.check_address(ipaddress.ip_address(address), scheme)
        return addresses


def is_public(address: IpAddress) -> bool:
    """Whether an address, or the IPv4 address that an IPv6 one leads to, is on the public internet."""
    if isinstance(address, ipaddress.IPv6Address):
        within = address.ipv4_mapped or address.sixtofour or (address.teredo or (None, None))[1]
        if within is None and address in _NAT64:
            within = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if within is not None:
            return is_public(within)
        if address.is_site_local or address in _EXAMPLES or int(address) >> 32 & 0xFFFFFFFF in _ISATAP:
            return False
    return address.is_global and not address.is_multicast and not address.is_reserved


def _literal(host: str) -> IpAddress | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
