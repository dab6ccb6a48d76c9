"""The page of `gs-jax explore`: a session of one person, and the HTTP server that answers its page.

The server listens on 127.0.0.1 and answers to no other host name, so a foreign page that resolves to this machine gets
nothing. All addresses begin with a secret token that changes each time: other pages and users do not know it.
"""

import json
import secrets
import sys
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ..base.errors import InputError
from ..codesign.study import Study
from ..design.design import Design, write_design
from .drawings import Psfs, draw_layout, line_chart, spot_rows, template
from .explore_design import (
    SPOT_DEPTHS,
    SPOT_FIELDS,
    Evaluation,
    Values,
    complete_values,
    evaluate_design,
    find_violations,
    live_terms,
    make_sliders,
    map_ghosts,
    moved_design,
    moved_imager,
    reconstruct_points,
    start_of,
)
from .pictures import png_uri, to_uint8

HOST = "127.0.0.1"
# Of a request's body, bytes: seven numbers with their names.
_MAX_BYTES = 4096
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
# Kept designs, and numbers after a file's name.
_MAX_KEPT, _MAX_NUMBER = 50, 10_000
# Columns of the history: numbers of which the largest of all depths is shown.
_COLUMNS = {
    "fwhm_um": "FWHM, um",
    "rms_width_um": "RMS width, um",
    "half_light_radius_um": "half-light radius, um",
    "lateral_resolution_um": "promised, um",
    "axial_resolution_um": "axial, um",
    "blur_um": "blur, um",
    "occupancy": "occupancy",
}


class Session:
    """One design that one person explores.

    Parameters
    ----------
    design
        The starting design.
    study
        The study whose targets are evaluated.
    path
        The file to save designs to; a number is added to its name if it exists.
    provenance
        The provenance of saved designs.
    """

    def __init__(self, design: Design, study: Study | None, path: Path, provenance: dict[str, str]):
        self.html = template("parts.html").module
        self.design, self.study, self.path, self.provenance = design, study, path, provenance
        self.start, self.sliders = start_of(design, study), make_sliders(design)
        self.terms = live_terms(study)
        self.kept: list[tuple[str, Values, Evaluation]] = []
        self.keep({}, "start")

    def page(self, token: str) -> str:
        """The page, as HTML."""
        late = [table.name for table in (self.study.terms if self.study else ()) if table.name not in self.terms]
        context = {"design": self.design, "sliders": self.sliders, "token": token, "late": late}
        return template("explore.html").render(context)

    def move(self, values: Values) -> dict[str, Any]:
        """Evaluate the design of these values: parts of the page by name, and the time that it took."""
        began = time.perf_counter()
        values, evaluation = self._evaluate(values)
        imager = moved_imager(self.start, values)
        ghosts = map_ghosts(imager, values["near_mm"], values["far_mm"])
        picture = _picture(np.sqrt(ghosts.crossings), 0.0, max(float(np.sqrt(ghosts.crossings.max())), 1.0))
        heights = np.array(SPOT_FIELDS) * values["field_radius_mm"]
        psfs = Psfs(evaluation.spots, evaluation.depths[list(SPOT_DEPTHS)], heights)
        violations = find_violations(self.design, self.study, self.start, values, evaluation)
        parts = {
            "violations": self.html.violations(violations),
            "numbers": self.html.numbers(evaluation, self.kept[0][2]),
            "spots": self.html.spots(psfs.depths, spot_rows(psfs)),
            "layout": draw_layout(imager, picture, ghosts.box, "where back-projection puts a point"),
            "chart": self._chart(evaluation),
        }
        return {"parts": parts, "ms": round(1000 * (time.perf_counter() - began))}

    def reconstruct(self, values: Values) -> dict[str, Any]:
        """Reconstruct a few points: a part of the page."""
        began = time.perf_counter()
        values, evaluation = self._evaluate(values)
        maxima, points, box, contrast = reconstruct_points(self.start, values, evaluation.clear_diameters)
        low, high = (float(value) for value in np.percentile(maxima, (50, 99.9)))
        picture = _picture(maxima, low, max(high, low + 1e-12))
        parts = {"small": self.html.reconstruction(picture, box, points.tolist(), contrast)}
        return {"parts": parts, "ms": round(1000 * (time.perf_counter() - began))}

    def keep(self, values: Values, name: str = "") -> dict[str, Any]:
        """Add the design of these values to the history."""
        if len(self.kept) >= _MAX_KEPT:
            raise InputError(f"at most {_MAX_KEPT} designs are kept.")
        self.kept.append((name or f"{len(self.kept)}", *self._evaluate(values)))
        return self.history()

    def save(self, values: Values) -> dict[str, Any]:
        """Write the design of these values to a new file."""
        values = complete_values(self.sliders, values)
        path = _free_path(self.path)
        write_design(path, moved_design(self.design, self.start, values, dict(self.provenance)))
        return {"said": f"Saved as {path.name}."}

    def history(self) -> dict[str, Any]:
        """The kept designs: a part of the page, and their values."""
        part = self.html.history(_COLUMNS, self.sliders, self.kept)
        return {"parts": {"history": part}, "kept": [values for _, values, _ in self.kept]}

    def _evaluate(self, values: Values) -> tuple[Values, Evaluation]:
        values = complete_values(self.sliders, values)
        return values, evaluate_design(self.start, values, self.terms)

    def _chart(self, now: Evaluation) -> str:
        line = lambda evaluation, name: (evaluation.depths, evaluation.numbers[name])
        lines = {"now": line(now, "rms_width_um"), "now, FWHM": line(now, "fwhm_um")}
        lines |= {"now, promised": line(now, "lateral_resolution_um"), "start": line(self.kept[0][2], "rms_width_um")}
        if len(self.kept) > 1:
            lines[f"kept {self.kept[-1][0]}"] = line(self.kept[-1][2], "rms_width_um")
        axes: Any = {"x": "depth z, mm", "y": "RMS width and FWHM, um", "title": "Image of a point"}
        return line_chart(lines, **axes, log=True, marks=True)


def _picture(values: np.ndarray, low: float, high: float) -> str:
    return png_uri(to_uint8(values, low, high), "magma")


def _free_path(path: Path) -> Path:
    """The path, or with the first number after its name that is free."""
    for number in range(1, _MAX_NUMBER):
        free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        if not free.exists():
            return free
    raise InputError(f"{path}: {_MAX_NUMBER} files of this name exist, choose another.")


class Server(ThreadingHTTPServer):
    """Serves the page of a session at `url`."""

    daemon_threads = True

    def __init__(self, session: Session, port: int = 0):
        super().__init__((HOST, port), _Handler)
        self.session, self.token = session, secrets.token_urlsafe(16)
        # One request at a time; but a move does not wait for a reconstruction.
        self.lock, self.reconstruction_lock = Lock(), Lock()
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.actions: dict[str, Callable[[dict[str, float]], dict[str, Any]]] = {
            "move": session.move,
            "reconstruct": session.reconstruct,
            "keep": session.keep,
            "save": session.save,
            "history": lambda _: session.history(),
        }

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print a fault, but not that the browser closed the page before its answer."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 60

    def do_GET(self) -> None:
        if not self._is_local():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", "gs-jax explore: not the address that it printed.\n")
        elif self.path == f"/{self.server.token}/":
            self._answer(HTTPStatus.OK, "text/html", self.server.session.page(self.server.token))
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", "gs-jax explore: no such page.\n")

    def do_POST(self) -> None:
        _, token, name = (*self.path.split("/"), "", "")[:3]
        if not self._is_local() or not secrets.compare_digest(token.encode(), self.server.token.encode()):
            return self._answer(HTTPStatus.FORBIDDEN, "text/plain", "gs-jax explore: not from its own page.\n")
        if name not in self.server.actions:
            return self._answer(HTTPStatus.NOT_FOUND, "text/plain", "gs-jax explore: no such page.\n")
        try:
            values = self._values()
            with self.server.reconstruction_lock if name == "reconstruct" else self.server.lock:
                answer = self.server.actions[name](values)
        except InputError as error:
            answer = {"error": str(error)}
        self._answer(HTTPStatus.OK, "application/json", json.dumps(answer))

    def _is_local(self) -> bool:
        """Whether the request names this machine, and comes from no other page."""
        origin, hosts = self.headers.get("Origin"), self.server.hosts
        return self.headers.get("Host") in hosts and origin in {None, *(f"http://{name}" for name in hosts)}

    def _values(self) -> dict[str, float]:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _MAX_BYTES:
            raise InputError(f"a request must have up to {_MAX_BYTES} bytes, got {length or 'no length'}.")
        try:
            data = json.loads(self.rfile.read(int(length)))
            return {str(name): float(value) for name, value in data.items()}
        except (ValueError, TypeError, AttributeError) as error:
            raise InputError("a request must be a JSON object of numbers.") from error

    def _answer(self, status: HTTPStatus, kind: str, text: str) -> None:
        body = text.encode()
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
        """Suppress per-request logging."""
