"""Rate limit of new sun positions for each client.

A new sun is a pair of a level and a sun (time or angles) that the client has not requested lately. Every new sun needs rendering.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from skugga.api.errors import RateLimitError
from skugga.terrain.cache import MIB, Cache, Missing

MAX_RECENT_SUNS = 256
"""Maximum number of recent suns of a client that are stored and not counted again.

All tiles of one map have the same sun, and count once."""

CLIENT_BYTES = 32 * 1024
"""Estimated bytes of the record of a client with ``MAX_RECENT_SUNS`` suns."""


@dataclass
class _Client:
    """The token bucket of a client.

    Attributes
    ----------
    tokens : float
        Tokens in the bucket at the time ``refilled_s``; a fraction of a token cannot be taken.
    refilled_s : float
        Time of the last refill, seconds of the limiter's clock.
    recent_suns : dict
        The client's recent suns as keys, the most recent last.
    """

    tokens: float
    refilled_s: float
    recent_suns: dict[Hashable, None] = field(default_factory=dict)


class RateLimiter:
    """A token bucket for each client, from which every new sun takes a token.

    ``suns_per_minute`` is the rate of new tokens and the size of a bucket; 0 means no limit. ``clock`` returns seconds.
    """

    def __init__(self, suns_per_minute: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._suns_per_minute, self._clock = suns_per_minute, clock
        self._clients: Cache[_Client] = Cache("skugga.api.http.state.rate_limiter", "process", 32 * MIB, lambda _: CLIENT_BYTES)

    def acquire(self, address: str, sun: Hashable) -> None:
        """Take a token from the bucket of the client at ``address``, unless the client has requested ``sun`` lately.

        Raises ``RateLimitError`` if no token is left.
        """
        if not self._suns_per_minute:
            return
        key, now_s = client_key(address), self._clock()
        cached = self._clients.get(key)
        client = _Client(float(self._suns_per_minute), now_s) if isinstance(cached, Missing) else cached
        client.tokens = min(
            client.tokens + (now_s - client.refilled_s) * self._suns_per_minute / 60.0, float(self._suns_per_minute)
        )
        client.refilled_s = now_s
        if isinstance(cached, Missing):
            self._clients.put(key, value=client)
        if sun in client.recent_suns:
            client.recent_suns[sun] = client.recent_suns.pop(sun)
            return
        if client.tokens < 1.0:
            wait_s = int((1.0 - client.tokens) * 60.0 / self._suns_per_minute) + 1
            raise RateLimitError(
                f"Too many new sun positions. The limit is {self._suns_per_minute} per minute for each client.", wait_s
            )
        client.tokens -= 1.0
        client.recent_suns[sun] = None
        while len(client.recent_suns) > MAX_RECENT_SUNS:
            client.recent_suns.pop(next(iter(client.recent_suns)))


def client_key(address: str) -> str:
    """Return the key of the client at an IP address: an IPv4 address, or the /64 network of an IPv6 address.

    One customer usually has a whole /64 network.
    """
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address[:64]
    if isinstance(ip, ipaddress.IPv6Address):
        mapped = ip.ipv4_mapped
        return str(mapped) if mapped is not None else str(ipaddress.ip_network((int(ip) >> 64 << 64, 64)))
    return str(ip)
