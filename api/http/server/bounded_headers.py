"""An HTTP protocol for uvicorn that limits the size of a request's line and headers.

The parser (httptools) itself has no such limit.
"""

from __future__ import annotations

from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from skugga.api.http.problems import Problem, problem_of, problem_response

MAX_HEAD_BYTES = 64 * 1024
"""Approximate limit in bytes of a request's line and headers.

The last received piece of data, which completes the headers, is not counted."""


class HeaderLimitProtocol(HttpToolsProtocol):
    """Protocol that closes a connection whose request line and headers exceed ``MAX_HEAD_BYTES``."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._in_head, self._has_ended, self._head_bytes = True, False, 0

    def data_received(self, data: bytes) -> None:
        """Parse received data, and add its size to the count while the headers are incomplete. Answer 431 above the limit."""
        self._has_ended = False
        super().data_received(data)
        if not self._in_head or self._has_ended or self.transport.is_closing():
            return  # data after the end of a request in the same packet is not counted
        self._head_bytes += len(data)
        if self._head_bytes > MAX_HEAD_BYTES:
            self._send_problem_and_close(problem_of(431))

    def send_400_response(self, msg: str) -> None:
        """Answer an invalid request with a problem document of status 400, and close the connection."""
        self._send_problem_and_close(problem_of(400))

    def _send_problem_and_close(self, problem: Problem) -> None:
        """Send a problem document as the response, and close the connection."""
        answer = problem_response(problem, {"Connection": "close"})
        head = [f"HTTP/1.1 {problem.status} {problem.title}".encode(), *(b": ".join(header) for header in answer.raw_headers)]
        self.transport.write(b"\r\n".join([*head, b"", bytes(answer.body)]))
        self.transport.close()

    def on_headers_complete(self) -> None:
        """Stop counting at the end of the headers."""
        self._in_head, self._head_bytes = False, 0
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Reset the count at the end of a request: another request may follow."""
        self._in_head, self._has_ended, self._head_bytes = True, True, 0
        super().on_message_complete()
