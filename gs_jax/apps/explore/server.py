"""The page's server: the standard library's, on this machine alone.

It listens on 127.0.0.1, answers to no other name (a page elsewhere that resolves to this machine gets nothing), and
all of its addresses begin with a secret that changes each time: other pages and users of the machine do not know it.
"""

import json
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock
from typing import Any

from ...base.errors import InputError
from .session import Session

HOST = "127.0.0.1"
# Of a question, bytes: seven numbers with their names.
_LONGEST = 4096
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


class Server(ThreadingHTTPServer):
    """Answers the page of a session; `url` is where it is."""

    daemon_threads = True

    def __init__(self, session: Session, port: int = 0):
        super().__init__((HOST, port), _Handler)
        self.session, self.token = session, secrets.token_urlsafe(16)
        # One of a kind at a time; a move does not wait for a reconstruction.
        self.turn, self.slow = Lock(), Lock()
        self.names = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.answers: dict[str, Callable[[dict[str, float]], dict[str, Any]]] = {
            "move": session.move,
            "reconstruct": session.reconstruct,
            "keep": session.keep,
            "save": session.save,
            "history": lambda _: session.history(),
        }

    @property
    def url(self) -> str:
        """Of the page, with its secret."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"


class _Handler(BaseHTTPRequestHandler):
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 60

    def do_GET(self) -> None:
        if not self._is_ours():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"gs-jax explore: not the address that it printed.\n")
        elif self.path == f"/{self.server.token}/":
            self._answer(HTTPStatus.OK, "text/html", self.server.session.page(self.server.token).encode())
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"gs-jax explore: nothing here.\n")

    def do_POST(self) -> None:
        _, token, name = (*self.path.split("/"), "", "")[:3]
        if not self._is_ours() or not secrets.compare_digest(token.encode(), self.server.token.encode()):
            return self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"gs-jax explore: not from its own page.\n")
        if name not in self.server.answers:
            return self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"gs-jax explore: nothing here.\n")
        try:
            values = self._values()
            with self.server.slow if name == "reconstruct" else self.server.turn:
                found = self.server.answers[name](values)
        except InputError as error:
            found = {"error": str(error)}
        self._json(found)

    def _is_ours(self) -> bool:
        """Whether it is asked by this machine's name, and by no other page."""
        origin = self.headers.get("Origin")
        own = {f"http://{name}" for name in self.server.names}
        return self.headers.get("Host") in self.server.names and (origin is None or origin in own)

    def _values(self) -> dict[str, float]:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _LONGEST:
            raise InputError(f"found a question of {length or 'no'} bytes, allowed: up to {_LONGEST}.")
        try:
            found = json.loads(self.rfile.read(int(length)))
            return {str(name): float(value) for name, value in found.items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise InputError("found no numbers, allowed: a number for each name.") from error

    def _json(self, data: dict[str, Any]) -> None:
        self._answer(HTTPStatus.OK, "application/json", json.dumps(data).encode())

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a terminal has better to say."""
