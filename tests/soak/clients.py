"""Clients that load a service over connections that stay open, and record the latency of each answer."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Answers:
    """Statuses and latencies in seconds, and the number of refusals with a Retry-After header."""

    statuses: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    retry_after_count: int = 0

    def ms(self, share: float, status: int | None = None) -> float:
        """Return the latency within which a share of the answers came, milliseconds."""
        latencies_s = [
            latency_s
            for latency_s, answer_status in zip(self.seconds, self.statuses, strict=True)
            if status in (None, answer_status)
        ]
        return float(np.quantile(latencies_s, share) * 1000.0) if latencies_s else float("nan")

    def count(self, status: int) -> int:
        """Return the number of answers with a status."""
        return self.statuses.count(status)

    def summary(self, name: str) -> str:
        """Format the statuses and times of the answers, after ``name``."""
        counts = ", ".join(f"{status}: {self.count(status)}" for status in sorted(set(self.statuses)))
        return (
            f"{name}: {len(self.statuses)} answers ({counts}); of 200 and 304 half within {self.success_ms(0.5):.1f} ms, "
            f"99 of 100 within {self.success_ms(0.99):.1f} ms"
        )

    def success_ms(self, share: float) -> float:
        """Return the milliseconds within which a share of the answers with status 200 or 304 came; NaN without any."""
        latencies_s = [
            latency_s for latency_s, answer_status in zip(self.seconds, self.statuses, strict=True) if answer_status in (200, 304)
        ]
        return float(np.quantile(latencies_s, share) * 1000.0) if latencies_s else float("nan")


class Connection:
    """One connection from a loopback address, reopened where the service has closed it.

    To the service each address is another client.
    """

    def __init__(self, port: int, address: str = "127.0.0.1") -> None:
        self._port, self._address = port, address
        self.body = b""
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def get(self, path: str, answers: Answers, headers: str = "") -> dict[str, str]:
        """Send one request, store the answer's ``body`` and return its headers; failures count as status 0."""
        start_s = time.perf_counter()
        self.body = b""
        response_headers: dict[str, str] = {}
        request = f"GET {path} HTTP/1.1\r\nHost: x\r\n{headers}\r\n".encode()
        try:
            first_line = b"" if self._streams is None else await self._send(request)
            if not first_line:  # the service closes connections that were idle for some seconds
                self.close()
                self._streams = await asyncio.open_connection("127.0.0.1", self._port, local_addr=(self._address, 0))
                first_line = await self._send(request)
            reader, _ = self._streams
            status = int(first_line.split()[1])
            while (line := (await reader.readline()).decode("latin-1").strip()) != "":
                name, _, value = line.partition(":")
                response_headers[name.lower()] = value.strip()
            if status != 304:
                self.body = await reader.readexactly(int(response_headers.get("content-length", 0)))
        except (OSError, EOFError, IndexError, ValueError, asyncio.IncompleteReadError):
            status = 0
            self.close()
        answers.statuses.append(status)
        answers.seconds.append(time.perf_counter() - start_s)
        answers.retry_after_count += status in (503, 429) and "retry-after" in response_headers
        return response_headers

    async def _send(self, request: bytes) -> bytes:
        """Return the first line of the answer; empty where the connection has been closed."""
        assert self._streams is not None
        reader, writer = self._streams
        try:
            writer.write(request)
            return await reader.readline()
        except ConnectionError:
            return b""

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def closed_loop(port: int, path: Callable[[], str], clients: int, seconds: float) -> Answers:
    """Run clients that each send the next request as soon as they have an answer."""
    answers = Answers()

    async def run_client() -> None:
        connection, end_s = Connection(port), time.perf_counter() + seconds
        while time.perf_counter() < end_s:
            await connection.get(path(), answers)
        connection.close()

    await asyncio.gather(*(run_client() for _ in range(clients)))
    return answers


async def open_loop(
    port: int, path: Callable[[], str], per_second: float, seconds: float, headers: str = "", warm_up_s: float = 0.0
) -> Answers:
    """Send requests at a steady rate, whether or not earlier ones have been answered.

    Answers to the requests of the first ``warm_up_s`` seconds are not recorded.
    """
    answers, warm_up_answers, idle_connections, running = Answers(), Answers(), list[Connection](), set[asyncio.Task[None]]()

    async def send_one() -> None:
        connection = idle_connections.pop() if idle_connections else Connection(port)
        await connection.get(path(), warm_up_answers if time.perf_counter() < start_s + warm_up_s else answers, headers)
        idle_connections.append(connection)

    start_s = time.perf_counter()
    for number in range(int(per_second * (seconds + warm_up_s))):
        await asyncio.sleep(max(start_s + number / per_second - time.perf_counter(), 0.0))
        task = asyncio.create_task(send_one())
        running.add(task)
        task.add_done_callback(running.discard)
    await asyncio.gather(*running)
    for connection in idle_connections:
        connection.close()
    return answers
