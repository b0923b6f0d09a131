"""The server that runs the application: sockets, logging, signals and shutdown."""

from __future__ import annotations

import asyncio
import logging
import resource
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import uvicorn

from skugga.api.http.server.app import create_app
from skugga.api.http.server.bounded_headers import HeaderLimitProtocol
from skugga.api.http.server.bounded_listener import BoundedListener
from skugga.api.http.server.request_middleware import LogFormatter
from skugga.api.http.server.watchdog import watch_event_loop
from skugga.api.http.state.service import Service
from skugga.api.settings import Settings
from skugga.api.workers.piped_process import SpawnedWorker
from skugga.api.workers.process_life import open_descriptors
from skugga.terrain.level.level_source import LevelSource

SHUTDOWN_GRACE_S = 3
"""Seconds that a stopping server gives clients to read their answers."""

DESCRIPTORS_PER_WORKER = 10
"""File descriptors reserved for each render process: its pipe, its sentinel and its start."""

DESCRIPTORS_PER_FILM = 4
"""File descriptors reserved for each film that is being drawn. A finished film needs one."""

RESERVED_DESCRIPTORS = 16
"""File descriptors reserved for files of levels and the viewer, and for logs."""

FOLDER_RETRY_DELAY_S = 5.0
"""Seconds until the next attempt to read the folder of levels, if no thread can be started for it."""

MIN_CONNECTIONS = 8
"""Lower bound of the number of connections, even if file descriptors do not suffice for them."""
LISTEN_BACKLOG = 2048
"""Number of connections that the operating system queues before they are accepted (see listen(2))."""


def log_config(settings: Settings) -> dict[str, Any]:
    """Return the logging configuration. All logs go to standard error.

    uvicorn logs errors only. Its warnings are about single bad requests, so clients could fill a disk by sending bad requests.
    """
    loggers = {"skugga": "INFO", "uvicorn.error": "ERROR", "uvicorn.access": "ERROR"}
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"line": {"()": LogFormatter, "as_json": settings.log_format == "json"}},
        "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "line"}},
        "loggers": {name: {"handlers": ["stderr"], "level": level, "propagate": False} for name, level in loggers.items()},
    }


log = logging.getLogger("skugga")


class Server(uvicorn.Server):
    """A uvicorn server with a limit of connections. It stops without waiting for pending pictures.

    SIGHUP makes the server check the files of all levels and archives and read the folder of levels again. SIGUSR1 makes it log the
    service's status. With ``ends_if_stuck`` the process ends if the event loop does not run for minutes.
    """

    def __init__(self, config: uvicorn.Config, service: Service, ends_if_stuck: bool = False) -> None:
        super().__init__(config)
        self._service = service
        self._ends_if_stuck = ends_if_stuck

    async def startup(self, sockets: Any = None) -> None:
        """Start the application, listen, install signal handlers and log the address."""
        config, settings = self.config, self._service.settings
        await self.lifespan.startup()
        if self.lifespan.should_exit:
            sys.exit(1)
        try:
            listening_sockets = list(sockets or _listening_sockets(config.host, config.port))
        except OSError as error:
            log.error("cannot listen on %s, port %d: %s", config.host, config.port, error.strerror)
            await self.lifespan.shutdown()
            sys.exit(1)

        def make_protocol() -> asyncio.Protocol:
            return config.http_protocol_class(  # type: ignore[call-arg]
                config=config, server_state=self.server_state, app_state=self.lifespan.state
            )

        limit = connection_limit(settings)
        self.servers = [
            BoundedListener(listening_socket, make_protocol, self.server_state.connections, limit, settings.client_timeout_s)  # type: ignore[misc]
            for listening_socket in listening_sockets
        ]
        self._install_signal_handlers()
        if self._ends_if_stuck:
            watch_event_loop(asyncio.get_running_loop())
        self.started = True
        served_names = [level.name for level in self._service.levels.cached_levels()]
        served_names += [f"archive {name}" for name in self._service.archives.names()]
        names = ", ".join(served_names) or "no level yet"
        host, port = listening_sockets[0].getsockname()[:2]
        log.info("Skugga serves %s on http://%s:%d", names, f"[{host}]" if ":" in host else host, port)

    async def shutdown(self, sockets: Any = None) -> None:
        """Stop animations and render processes, answer pending requests, and stop the server."""
        await self._service.close()
        await super().shutdown(sockets)
        log.info("Skugga has stopped")

    def _install_signal_handlers(self) -> None:
        """Handle SIGHUP and SIGUSR1 in the event loop, if this is the main thread of a system with signals."""
        with suppress(RuntimeError, ValueError, NotImplementedError):  # only the main thread handles signals
            loop = asyncio.get_running_loop()
            loop.add_signal_handler(signal.SIGHUP, self._reload)
            loop.add_signal_handler(signal.SIGUSR1, self._log_status)

    def _reload(self) -> None:
        """Check the files of all levels and archives at their next use, and read the folder of levels again."""
        log.info("SIGHUP: checking the files of all levels and archives")
        self._service.levels.expire_all()
        self._service.archives.expire_all()
        self._read_folder()

    def _read_folder(self) -> None:
        """Read the folder of levels in its own thread, without a time limit. Retry later if no thread can be started."""
        try:
            threading.Thread(target=self._service.levels.reload_folder, name="read the folder of levels", daemon=True).start()
        except (RuntimeError, MemoryError) as error:
            log.error("the folder of levels cannot be read: %s; retrying in %g s", error, FOLDER_RETRY_DELAY_S)
            asyncio.get_running_loop().call_later(FOLDER_RETRY_DELAY_S, self._read_folder)

    def _log_status(self) -> None:
        """Log the numbers of connections, requests, jobs and animations, and the process ids of the render processes."""
        pool = self._service.pool
        log.info(
            "SIGUSR1: %d connections, %d requests, %d jobs queued, %d jobs running, %d animations pending, render processes %s",
            len(self.server_state.connections), len(self.server_state.tasks), pool.queued_count, pool.running_count,
            self._service.animations.active_count, sorted(pool.ready_pids),
        )  # fmt: skip


def connection_limit(settings: Settings) -> int:
    """Return the maximum number of connections: ``settings.max_connections``, or fewer if file descriptors do not suffice."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return settings.max_connections
    film_descriptors = settings.animations_kept + DESCRIPTORS_PER_FILM * settings.animations_at_a_time
    available = soft - open_descriptors() - DESCRIPTORS_PER_WORKER * settings.workers - film_descriptors - RESERVED_DESCRIPTORS
    if available < settings.max_connections:
        log.warning(
            "the limit of connections is reduced to %d, because the limit of open files is %d",
            max(available, MIN_CONNECTIONS),
            soft,
        )
    return min(settings.max_connections, max(available, MIN_CONNECTIONS))


def serve(
    settings: Settings,
    levels: Sequence[Path | LevelSource],
    archives: Sequence[Path] = (),
    spawned_worker: SpawnedWorker | None = None,
) -> None:
    """Serve levels and archives until SIGINT or SIGTERM.

    ``spawned_worker`` is the first render process, if it has been started already. Raises the errors of ``create_app``.
    """
    app = create_app(settings, levels, archives=archives, spawned_worker=spawned_worker)
    config = uvicorn.Config(
        app, host=settings.host, port=settings.port, access_log=False, log_config=log_config(settings), http=HeaderLimitProtocol,
        ws="none", server_header=False, timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
    )  # fmt: skip
    with suppress(KeyboardInterrupt):
        Server(config, app.state.service, ends_if_stuck=True).run()


def _listening_sockets(host: str, port: int) -> list[socket.socket]:
    """Return listening sockets for all addresses of a host name."""
    address_infos = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    addresses = dict.fromkeys((family, address) for family, _, _, _, address in address_infos)
    return [socket.create_server(address, family=family, backlog=LISTEN_BACKLOG) for family, address in addresses]
