"""Pictures and films of a solution on a plain page, for problems without a model to show."""

from __future__ import annotations

import base64
import html
import threading
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from mjx_drax.base.errors import DraxError
from mjx_drax.solution.solution import Solution
from mjx_drax.view.browser.viewer import PORT, checked_port
from mjx_drax.view.video import outcome_lines

_PAGE = """<!doctype html><meta charset="utf-8"><title>{name}</title>
<link rel="icon" href="data:,"><style>
body {{ margin: 2em auto; max-width: 60em; padding: 0 1em; font: 16px/1.5 sans-serif }}
img, video {{ width: 100% }}
figure {{ margin: 2em 0 }}
</style>
<h1>{name}</h1><p>{told}</p>{figures}"""
_FIGURE = "<figure>{shown}<figcaption>{name}</figcaption></figure>"
_FILM = '<video controls loop muted autoplay src="data:video/mp4;base64,{data}"></video>'
_PICTURE = '<img src="data:image/png;base64,{data}" alt="{name}">'


def show_pictures(
    solution: Solution,
    files: Sequence[Path],
    *,
    port: int = PORT,
    told: Callable[[str], object] = print,
    until: threading.Event | None = None,
) -> None:
    """Serve a page with words on a solution's best chain and with files, until Ctrl-C.

    Args:
        solution: whose pictures these are.
        files: .mp4 and .png, in the order of the page.
        port, told, until: as in `viewer.show`.

    Raises:
        DraxError: there are no files, one cannot be read, or the port is in use.
    """
    name, until = solution.problem.name, until or threading.Event()
    if not files:
        raise DraxError(
            f"{name} has no MuJoCo model to show, and there are no pictures beside its result: "
            "`mjx-drax solve` writes them."
        )
    page = _page(solution, files).encode()

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, *_: object) -> None:
            """Requests are nobody's business."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", checked_port(port)), Answer)
    except OSError as error:
        raise DraxError(f"port {port} of this machine cannot be opened: {error}") from error
    with server:
        told(f"open http://127.0.0.1:{server.server_port} in a browser; Ctrl-C ends it")
        server.timeout = 0.1
        while not until.is_set():
            server.handle_request()


def _page(solution: Solution, files: Sequence[Path]) -> str:
    """All in one text: words, and the files as they are."""
    figures = []
    for path in files:
        try:
            data = base64.b64encode(path.read_bytes()).decode()
        except OSError as error:
            raise DraxError(f"cannot read {path}: {error}") from error
        kind = _FILM if path.suffix == ".mp4" else _PICTURE
        figures.append(_FIGURE.format(shown=kind.format(data=data, name=path.name), name=path.name))
    name, *lines = map(html.escape, outcome_lines(solution)[:-1])  # without the time
    return _PAGE.format(name=name, told="<br>".join(lines), figures="".join(figures))
