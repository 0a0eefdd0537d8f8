"""The command `microid serve`: its options, and the work."""

import functools
import sys
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import click

from fits.cli import _common as common
from fits.cli import _late as late
from fits.io._errors import DataError

_HERE = "127.0.0.1"


class _Pages(SimpleHTTPRequestHandler):
    """Files of a folder, and in place of the folder the page of what it holds; to browsers on this machine alone."""

    def do_GET(self) -> None:
        """Answer; another name for this machine may be that of a page from elsewhere that wants to read along."""
        name = (self.headers["Host"] or "").rpartition(":")[0]
        place = Path(self.translate_path(self.path))
        if name not in (_HERE, "localhost") or (place.is_dir() and place != Path(self.directory)):
            self.send_error(HTTPStatus.NOT_FOUND)
        elif page := self._made(place):
            content = page.encode()
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)
        else:
            super().do_GET()

    @staticmethod
    def _made(place: Path) -> str | None:
        """The page of the folder, or of a result in it that has none of its own; None for a file that is there."""
        if place.is_dir():
            return late.gallery_html(place)
        return late.result_html(place.with_suffix("")) if not place.exists() and place.suffix == ".html" else None

    def end_headers(self) -> None:
        """Let a browser keep nothing: results change."""
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, *_: Any) -> None:
        """Print nothing."""


class _Server(ThreadingHTTPServer):
    """Answers browsers, which may hang up before they have all."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print what went wrong, but for an answer that nobody waits for any more."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


@click.command()
@click.argument("folder", metavar="DIR")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8027, show_default=True, help="Port; 0 for any that is free."
)
@common.in_sentences
def serve(given: common.Given) -> None:
    """Show diagnoses, fits and sweeps in DIR side by side in a browser on this machine, until Ctrl-C.

    Reports, pages beside pictures, model files and sweeps of the folder and of those in it stand on one page. Nothing
    is written, and no other machine is answered.
    """
    if not Path(given.folder).is_dir():
        raise DataError(f"{given.folder}: there is no such folder; give one that holds results.")
    pages = functools.partial(_Pages, directory=str(Path(given.folder).resolve()))
    try:
        opened = _Server((_HERE, given.port), pages)
    except OSError as error:
        why = f"--port {given.port}: the system refuses it ({error.strerror})"
        raise DataError(f"{why}; choose another, or 0 for any that is free.") from None
    with opened as server:
        click.echo(f"{given.folder} is at http://{_HERE}:{server.server_port}/ until Ctrl-C")
        server.serve_forever()
