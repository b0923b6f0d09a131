"""Idle and stalled connections, and more connections than file descriptors, do not block other clients."""

import contextlib
import resource
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from skugga.api.http.server.server import connection_limit
from skugga.api.settings import Settings
from tests.api.conftest import Client
from tests.api.workers import fake_workers

TIMEOUT_S = 20.0


@pytest.fixture
def open_sockets() -> Iterator[Callable[[Client, bytes], socket.socket]]:
    """A function that connects to a service and sends it bytes. All sockets are closed after the test."""
    with ExitStack() as stack:

        def connect(client: Client, data: bytes = b"") -> socket.socket:
            connection = stack.enter_context(
                socket.create_connection((client.base_url.host, client.base_url.port), timeout=TIMEOUT_S)
            )
            connection.sendall(data)
            return connection

        yield connect


def is_ended(connection: socket.socket) -> bool:
    """Return whether the server closes a connection within ``TIMEOUT_S``."""
    connection.settimeout(TIMEOUT_S)
    try:
        while connection.recv(65536):
            pass
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET /healthz HT",
        b"GET /healthz HTTP/1.1\r\nHost: x\r\n",
        b"POST /plan HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{",
        b"POST /plan HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1\r\n{\r\n",
    ],
)
def test_stalled_request_closes_its_connection(serve_with, open_sockets, sent: bytes):
    client = serve_with(fake_workers.scripted, client_timeout_s=0.3)
    assert is_ended(open_sockets(client, sent))


def test_request_sent_byte_by_byte_times_out(serve_with, open_sockets):
    client = serve_with(fake_workers.scripted, client_timeout_s=0.5)
    connection = open_sockets(client, b"GET /healthz HTTP/1.1\r\nX: ")
    until_s = time.monotonic() + TIMEOUT_S
    with pytest.raises(OSError):
        while time.monotonic() < until_s:
            connection.sendall(b"x")
            time.sleep(0.05)


@pytest.mark.parametrize(
    "request_start", [b"GET /", b"GET /healthz HTTP/1.1\r\nX: ", b"GET /healthz HTTP/1.1\r\n" + b"A: b\r\n" * 100]
)
def test_endless_headers_close_the_connection(serve_with, open_sockets, request_start: bytes):
    client = serve_with(fake_workers.scripted)
    connection = open_sockets(client, request_start)
    part = b"x" * 65536 if not request_start.endswith(b"\n") else b"A: b\r\n" * 10_000
    sent_bytes = 0
    with contextlib.suppress(OSError):
        while sent_bytes < 64 * 2**20:
            connection.sendall(part)
            sent_bytes += len(part)
    assert sent_bytes < 32 * 2**20, "the server closed the connection long before 64 MiB"
    assert client.get("/healthz").status_code == 200


def test_header_limit_holds_per_request(serve_with):
    client = serve_with(fake_workers.scripted)
    for _ in range(40):
        assert client.get("/healthz", headers={"X": "x" * 8000}).status_code == 200
    assert client.post("/plan", content=b"x" * 500_000).status_code == 422


def test_unread_answers_close_their_connection(serve_with, open_sockets):
    client = serve_with(fake_workers.scripted, client_timeout_s=0.5)
    response_bytes, request_count = len(client.get("/openapi.json").content), 500
    connection = open_sockets(client, b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n" * request_count)
    assert connection.recv(1) == b"H", "the server has accepted the connection"
    while client.get("/healthz").status_code == 200 and _connections(client) > 1:
        time.sleep(0.05)
    assert 0 < _received_bytes(connection) < response_bytes * request_count, "only the bytes in the system's buffers arrive"


def _connections(client: Client) -> int:
    """Return the number of connections that the service holds open."""
    return len(client.server.server_state.connections)


def _received_bytes(connection: socket.socket) -> int:
    """Read a socket until the service closes it, and return the number of bytes."""
    connection.settimeout(TIMEOUT_S)
    count = 0
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(1 << 20):
            count += len(part)
    return count


def test_idle_connections_are_evicted(serve_with, open_sockets):
    client = serve_with(fake_workers.scripted, max_connections=8)
    idle_connections = [open_sockets(client) for _ in range(40)]
    for _ in range(5):
        with socket.create_connection((client.base_url.host, client.base_url.port), timeout=TIMEOUT_S) as connection:
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 200")
    assert is_ended(idle_connections[0])


def test_server_recovers_from_running_out_of_descriptors(serve_with, open_sockets, caplog: pytest.LogCaptureFixture):
    """A server without free file descriptors pauses accepting, logs this at most once, and goes on later."""
    client = serve_with(fake_workers.scripted)
    assert client.get("/readyz").status_code in (200, 503)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    sockets = [socket.socket() for _ in range(60)]
    try:
        for connection in sockets[30:]:
            connection.settimeout(TIMEOUT_S)
        descriptor_count = max(connection.fileno() for connection in sockets) + 1
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptor_count + 5, hard))
        for connection in sockets:
            connection.connect((client.base_url.host, client.base_url.port))
        time.sleep(1.5)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        sockets[-1].sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert sockets[-1].recv(100).startswith(b"HTTP/1.1 200")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for connection in sockets:
            connection.close()
    log_records = [record for record in caplog.records if "cannot be accepted" in record.getMessage()]
    assert len(log_records) <= 1


def test_connection_limit_leaves_spare_descriptors():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert connection_limit(Settings(workers=1, max_connections=5)) == 5
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(300, 0), hard))
        assert 8 <= connection_limit(Settings(workers=2, max_connections=1000)) < 280
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
