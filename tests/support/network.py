"""A network whose connections a test can cut: network namespaces on one bridge. Making them needs root."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

import pytest

HERE = "here"
"""The host that the test itself runs on."""
NOBODY = "02:00:00:00:00:ff"
"""A hardware address that no host has."""


class Network:
    """Hosts by name, each with one address. A cut drops packets silently, like an unplugged cable."""

    def __init__(self, hosts: Sequence[str]) -> None:
        # Names and addresses contain the process id, so that several networks can exist at once.
        self._bridge, numbers = f"dn{os.getpid()}", f"198.18.{os.getpid() % 256}"
        self._addresses = {host: f"{numbers}.{number}" for number, host in enumerate((HERE, *hosts), 1)}

    def open(self) -> None:
        """Make the bridge and the hosts."""
        _ip("link", "add", self._bridge, "type", "bridge")
        _ip("addr", "add", f"{self._addresses[HERE]}/24", "dev", self._bridge)
        _ip("link", "set", self._bridge, "up")
        for number, (host, address) in enumerate(self._addresses.items()):
            if host == HERE:
                continue
            space, port = self._space(host), f"{self._bridge}p{number}"
            _ip("netns", "add", space)
            _ip("link", "add", port, "type", "veth", "peer", "name", "eth0", "netns", space)
            _ip("link", "set", port, "master", self._bridge, "up")
            _ip("-n", space, "addr", "add", f"{address}/24", "dev", "eth0")
            _ip("-n", space, "link", "set", "eth0", "up")
            _ip("-n", space, "link", "set", "lo", "up")

    def close(self) -> None:
        """Remove the bridge and the hosts."""
        for host in self._addresses:
            if host != HERE:
                _ip("netns", "delete", self._space(host), check=False)
        _ip("link", "delete", self._bridge, check=False)

    def address(self, host: str) -> str:
        """IP address of one host."""
        return self._addresses[host]

    def inside(self, host: str) -> list[str]:
        """Prefix of a command line that makes it run on a host."""
        return (
            [] if host == HERE else ["nsenter", f"--net=/run/netns/{self._space(host)}"]
        )  # not ip netns exec, which also changes the mounted file systems

    def cut(self, one: str, other: str) -> None:
        """Drop all packets between two hosts without an error to either: their packets go to a hardware address that
        nobody has.
        """
        self._misdirect(one, other)
        self._misdirect(other, one)

    def heal(self, one: str, other: str) -> None:
        """Let packets between two hosts through again."""
        for near, far in ((one, other), (other, one)):
            _ip(*self._table(near), "neigh", "delete", self.address(far), "dev", self._device(near))

    def _misdirect(self, near: str, far: str) -> None:
        _ip(
            *self._table(near),
            "neigh",
            "replace",
            self.address(far),
            "lladdr",
            NOBODY,
            "nud",
            "permanent",
            "dev",
            self._device(near),
        )

    def _table(self, host: str) -> list[str]:
        return [] if host == HERE else ["-n", self._space(host)]

    def _device(self, host: str) -> str:
        return self._bridge if host == HERE else "eth0"

    def _space(self, host: str) -> str:
        return f"{self._bridge}-{host}"


@contextmanager
def network_of(*hosts: str) -> Iterator[Network]:
    """Make a network for the time of the block. The test is skipped where namespaces cannot be made."""
    network = Network(hosts)
    try:
        try:
            network.open()
        except (OSError, subprocess.CalledProcessError) as problem:
            pytest.skip(f"No network of its own: {problem}")
        yield network
    finally:
        network.close()


def _ip(*arguments: str, check: bool = True) -> None:
    with suppress(*(() if check else (OSError,))):
        subprocess.run(["ip", *arguments], check=check, capture_output=True)
