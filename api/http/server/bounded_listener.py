"""Accept connections up to a limit, evict idle connections and reap stalled ones.

At the limit, a new connection evicts the idle connection that has waited longest for its client's request. Without an idle
connection, no connection is accepted until another one closes. Clients that send nothing, or send slowly, therefore block no other
client.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

log = logging.getLogger("skugga")

MAX_ACCEPTS_PER_STEP = 64
"""Maximum number of connections that are accepted in one step of the event loop."""

REAP_INTERVAL_S = 0.25
"""Seconds between two searches for stalled connections (those whose client neither sends nor reads in time)."""

ACCEPT_RETRY_DELAY_S = 0.5
"""Seconds before connections are accepted again after ``accept`` has failed, for example without file descriptors."""

LOG_INTERVAL_S = 60.0
"""Minimum seconds between two log messages about a lack of file descriptors or memory."""

EXHAUSTION_ERRNOS = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}


class HttpConnection(Protocol):
    """The part of uvicorn's HTTP protocol that the listener uses.

    Attributes
    ----------
    transport : asyncio.Transport
        The connection's transport.
    cycle : object or None
        uvicorn's object for the current request and its response.
    """

    transport: asyncio.Transport
    cycle: Any


@dataclass
class _WaitState:
    """The state of a connection, and the time of its last change.

    Attributes
    ----------
    progress : tuple
        The value of ``_client_progress``, which changes as the client makes progress.
    changed_s : float
        Time of the last change in seconds, by the event loop's clock.
    """

    progress: tuple[object, ...]
    changed_s: float


class BoundedListener:
    """A listener that accepts connections up to a limit. It replaces the ``asyncio.Server`` of uvicorn.

    Parameters
    ----------
    listening_socket
        The listening socket.
    make_protocol
        Returns the protocol of a new connection.
    connections
        The server's set of open connections.
    max_connections
        Maximum number of connections.
    client_timeout_s
        Seconds within which a client must send all headers, send the whole body, or read some of its answer.

    Attributes
    ----------
    closed_count : int
        Number of connections that the listener has evicted or reaped.
    """

    def __init__(
        self,
        listening_socket: socket.socket,
        make_protocol: Callable[[], asyncio.Protocol],
        connections: set[Any],
        max_connections: int,
        client_timeout_s: float,
    ) -> None:
        self.sockets = (listening_socket,)
        self.closed_count = 0
        self._listening_socket, self._make_protocol = listening_socket, make_protocol
        self._connections, self._max_connections, self._client_timeout_s = connections, max_connections, client_timeout_s
        self._connecting_tasks: set[asyncio.Task[Any]] = set()
        self._wait_states: dict[HttpConnection, _WaitState] = {}
        self._loop = asyncio.get_running_loop()
        self._last_log_s = -LOG_INTERVAL_S
        self._paused_until_s = 0.0
        self._is_accepting = False
        self._is_closed = False
        listening_socket.setblocking(False)
        self._reap_timer: asyncio.TimerHandle = self._loop.call_soon(self._reap_stalled)  # type: ignore[assignment]
        self._resume()

    def close(self) -> None:
        """Stop accepting connections and close the socket."""
        self._is_closed = True
        self._pause()
        self._reap_timer.cancel()
        self._listening_socket.close()

    async def wait_closed(self) -> None:
        """Wait until the connections that were just accepted have their protocol."""
        if self._connecting_tasks:
            await asyncio.wait(self._connecting_tasks)

    def _resume(self) -> None:
        """Accept connections again, unless the listener is closed."""
        if not self._is_accepting and not self._is_closed:
            self._is_accepting = True
            self._loop.add_reader(self._listening_socket, self._accept)

    def _pause(self) -> None:
        """Accept no connections until ``_resume`` is called. The operating system queues new ones."""
        if self._is_accepting:
            self._is_accepting = False
            self._loop.remove_reader(self._listening_socket)

    def _accept(self) -> None:
        """Accept the connections that wait, until the limit is reached or ``accept`` fails. The event loop calls it."""
        for _ in range(MAX_ACCEPTS_PER_STEP):
            if len(self._connections) + len(self._connecting_tasks) >= self._max_connections and not self._evict_idle():
                self._pause()
                return
            try:
                client, _ = self._listening_socket.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                self._pause()
                self._paused_until_s = self._loop.time() + ACCEPT_RETRY_DELAY_S
                if error.errno not in EXHAUSTION_ERRNOS or self._loop.time() - self._last_log_s >= LOG_INTERVAL_S:
                    self._last_log_s = self._loop.time()
                    log.error("connections cannot be accepted: %s; retrying every %g s", error.strerror, ACCEPT_RETRY_DELAY_S)
                return
            client.setblocking(False)
            task = self._loop.create_task(self._connect(client))
            self._connecting_tasks.add(task)
            task.add_done_callback(self._on_connected)

    def _on_connected(self, task: asyncio.Task[Any]) -> None:
        """Forget the task that has set up a connection, and accept further connections unless ``accept`` has failed lately."""
        self._connecting_tasks.discard(task)
        if self._loop.time() >= self._paused_until_s:
            self._resume()

    async def _connect(self, client: socket.socket) -> None:
        """Set up the HTTP protocol of an accepted connection. ``client`` is its socket."""
        try:
            await self._loop.connect_accepted_socket(self._make_protocol, client)
        except OSError:  # the client has already disconnected
            client.close()

    def _evict_idle(self) -> bool:
        """Close the idle connection that has waited longest for its client's request. Return whether there was one."""
        self._update_waiting()
        idle = [(state.changed_s, connection) for connection, state in self._wait_states.items() if _awaits_request(connection)]
        if not idle:
            return False
        _, longest_idle = min(idle, key=lambda entry: entry[0])
        self._close_connection(longest_idle)
        return True

    def _reap_stalled(self) -> None:
        """Close stalled connections, resume accepting after a pause, and schedule the next call."""
        self._update_waiting()
        now_s = self._loop.time()
        for connection, state in list(self._wait_states.items()):
            if now_s - state.changed_s > self._client_timeout_s and _waits_for_client(connection):
                self._close_connection(connection)
        if now_s >= self._paused_until_s:
            self._resume()
        self._reap_timer = self._loop.call_later(REAP_INTERVAL_S, self._reap_stalled)

    def _update_waiting(self) -> None:
        """Record the connections whose client has made progress since the last call, and forget closed connections."""
        now_s = self._loop.time()
        for connection in list(self._wait_states):
            if connection not in self._connections:
                del self._wait_states[connection]
        for connection in self._connections:
            progress, state = _client_progress(connection), self._wait_states.get(connection)
            if state is None or state.progress != progress:
                self._wait_states[connection] = _WaitState(progress, now_s)

    def _close_connection(self, connection: HttpConnection) -> None:
        """Close a connection at once, without sending what is buffered, and count it."""
        self.closed_count += 1
        self._connections.discard(connection)
        self._wait_states.pop(connection, None)
        connection.transport.abort()


def _client_progress(connection: HttpConnection) -> tuple[object, ...]:
    """Return a value that changes when a client completes its headers or body, or reads some of its answer.

    Partial headers and a partial body do not change it.
    """
    cycle = connection.cycle
    if cycle is None:
        return ("headers",)
    return id(cycle), cycle.response_complete, cycle.more_body, connection.transport.get_write_buffer_size()


def _awaits_request(connection: HttpConnection) -> bool:
    """Return whether a connection is idle: it waits for the rest of a request, or for the next request."""
    cycle = connection.cycle
    return cycle is None or (cycle.more_body and not cycle.response_started) or cycle.response_complete


def _waits_for_client(connection: HttpConnection) -> bool:
    """Return whether a connection waits for its client: for a request, or for the client to read its answer."""
    return _awaits_request(connection) or connection.transport.get_write_buffer_size() > 0
