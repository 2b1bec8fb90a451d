"""Where webhooks may go: addresses that are not public are refused, in every spelling, before and after the name is
resolved.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.api.webhooks.address import AddressPolicy, is_public
from services.client.errors import WebhookAddressError

STRICT, PRIVATE = AddressPolicy(), AddressPolicy(allow_private=True)
HIDDEN = (
    "127.0.0.1", "10.1.2.3", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0", "224.0.0.1",
    "255.255.255.255", "240.0.0.1", "::1", "::", "fe80::1", "fc00::1", "fec0::1", "ff02::1", "::ffff:127.0.0.1",
    "::ffff:169.254.169.254", "64:ff9b::7f00:1", "2002:7f00:1::", "2001:db8::1", "3fff::1", "3fff:fff::1",
    "2001:4860::5efe:7f00:1", "2606:2800::200:5efe:a9fe:a9fe", "2606:2800::5efe:5db8:d822",
)  # fmt: skip
PUBLIC = ("93.184.216.34", "2606:2800:220:1:248:1893:25c8:1946", "::ffff:93.184.216.34", "64:ff9b::5db8:d822")


def resolve(policy: AddressPolicy, host: str, scheme: str = "https") -> list[str]:
    return asyncio.run(policy.resolve(host, 443, scheme))


@pytest.mark.parametrize("address", HIDDEN)
@pytest.mark.attack("webhooks", "an address inside, as it is or inside an IPv6 one, tunnels included")
def test_what_is_not_public_is_refused(address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    with pytest.raises(WebhookAddressError, match="no public address"):
        STRICT.check_url(f"https://{host}/hook")
    with pytest.raises(WebhookAddressError, match="no public address"):
        resolve(STRICT, address)


@pytest.mark.parametrize("address", PUBLIC)
def test_what_is_public_needs_tls(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    for policy in (STRICT, PRIVATE):
        policy.check_url(f"https://{host}:8443/hook?key=1")
        assert resolve(policy, address) == [address]
        with pytest.raises(WebhookAddressError, match="must be https"):
            policy.check_url(f"http://{host}/hook")
    with pytest.raises(WebhookAddressError, match="must be https"):
        resolve(PRIVATE, address, "http")


@given(number=st.integers(0, 2**32 - 1))
@pytest.mark.attack("webhooks", "any IPv4 address inside an IPv6 one")
def test_an_address_inside_another_is_as_public_as_itself(number: int) -> None:
    inner = ipaddress.IPv4Address(number)
    for outer in (0xFFFF << 32 | number, 0x64_FF9B << 96 | number, 0x2002 << 112 | number << 80):
        assert is_public(ipaddress.IPv6Address(outer)) is is_public(inner)


@pytest.mark.parametrize("host", ["localhost", "2130706433", "0x7f000001", "127.1", "0177.0.0.1"])
@pytest.mark.attack("webhooks", "loopback in another spelling")
def test_other_spellings_are_refused_once_they_are_resolved(host: str) -> None:
    with pytest.raises(WebhookAddressError):
        resolve(STRICT, host)


@pytest.mark.attack("webhooks", "a name with an address inside beside public ones")
def test_one_hidden_address_among_public_ones_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(*_: Any, **__: Any) -> list[Any]:
        return [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 443)) for address in ("93.184.216.34", "10.0.0.1")
        ]

    monkeypatch.setattr(socket, "getaddrinfo", answer)
    with pytest.raises(WebhookAddressError, match=r"10\.0\.0\.1"):
        resolve(STRICT, "two-faced.example")


@pytest.mark.parametrize("address", ["127.0.0.1", "10.1.2.3", "::1", "fe80::1"])
def test_a_setting_opens_private_addresses(address: str) -> None:
    host = f"[{address}]" if ":" in address else address
    PRIVATE.check_url(f"http://{host}:8000/hook")
    PRIVATE.check_url(f"https://{host}/hook")
    assert resolve(PRIVATE, address, "http") == [address]


@pytest.mark.parametrize("address", ["224.0.0.1", "0.0.0.0", "ff02::1"])
@pytest.mark.attack("webhooks", "an address of no host where private ones are allowed")
def test_no_setting_opens_what_is_no_host(address: str) -> None:
    with pytest.raises(WebhookAddressError):
        resolve(PRIVATE, address)


@pytest.mark.parametrize(
    "url",
    ["", "/hook", "example.org/hook", "ftp://example.org/", "file:///etc/passwd", "https://", "https:///hook",
    "https://u:p@example.org/", "https://a@example.org",
     "https://example.org/#part", "https://exa mple.org/", "https://example.org:99999/", "https://example.org/\n",
     "https://[::1", "http://example.org/"],
)  # fmt: skip
@pytest.mark.attack("webhooks", "another scheme, a login or a malformed address")
def test_what_is_no_secure_web_address_is_refused(url: str) -> None:
    with pytest.raises(WebhookAddressError):
        STRICT.check_url(url)


def test_a_name_without_address_is_a_sentence() -> None:
    with pytest.raises(WebhookAddressError, match="cannot be resolved"):
        resolve(STRICT, "no-such-host.invalid")
