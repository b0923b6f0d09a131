"""How many suns that are new to it one client may ask for: each of them has to be drawn."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from skugga.api.errors import TooManySunsError
from skugga.terrain.cache import MIB, Cache, Missing

REMEMBERED = 256
"""Suns that a client's are compared with: the tiles of one picture have one."""

CLIENT_BYTES = 32 * 1024
"""About what a client takes that asked for so many."""


@dataclass
class _Client:
    left: float
    seen_s: float
    suns: dict[Hashable, None] = field(default_factory=dict)
    """The one asked for last at the end."""


class NewSuns:
    """A bucket of suns for each address, filled at a steady rate; ``a_minute`` is its size, too. 0: no limit."""

    def __init__(self, a_minute: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._a_minute, self._clock = a_minute, clock
        self._clients: Cache[_Client] = Cache("skugga.api.http.state.new_suns", "process", 32 * MIB, lambda _: CLIENT_BYTES)

    def take(self, address: str, sun: Hashable) -> None:
        """Count a sun that a client asks for, if it is new. Raises ``TooManySunsError``."""
        if not self._a_minute:
            return
        key, now_s = network_of(address), self._clock()
        found = self._clients.get(key)
        client = _Client(float(self._a_minute), now_s) if isinstance(found, Missing) else found
        client.left = min(client.left + (now_s - client.seen_s) * self._a_minute / 60.0, float(self._a_minute))
        client.seen_s = now_s
        if isinstance(found, Missing):
            self._clients.put(key, value=client)
        if sun in client.suns:
            client.suns[sun] = client.suns.pop(sun)
            return
        if client.left < 1.0:
            wait_s = int((1.0 - client.left) * 60.0 / self._a_minute) + 1
            raise TooManySunsError(f"At most {self._a_minute} new suns a minute for one client.", wait_s)
        client.left -= 1.0
        client.suns[sun] = None
        while len(client.suns) > REMEMBERED:
            client.suns.pop(next(iter(client.suns)))


def network_of(address: str) -> str:
    """What counts as one client: an address, of IPv6 its network of 64 bits, which one customer has."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address[:64]
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        return str(mapped) if mapped is not None else str(ipaddress.ip_network((int(ip) >> 64 << 64, 64)))
    return str(ip)
