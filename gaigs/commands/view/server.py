"""The viewer's server on this machine: a page, and answers of a model."""

import json
import logging
import re
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from gaigs.commands.view.contents import Contents

log = logging.getLogger(__name__)


def server(page: str, contents: list[Contents], port: int) -> ThreadingHTTPServer:
    """A server of the page at ``/`` and of answers, not yet started.

    Answers are at ``/answer``, ``/slice`` and ``/comparison``. The server accepts only host names
    of this machine: a foreign name that resolves to this machine gets no data.
    """

    class Handler(BaseHTTPRequestHandler):
        """Answers the requests of one connection."""

        protocol_version = "HTTP/1.1"  # one connection for all answers

        def do_GET(self) -> None:
            """Sends the page, an answer, or the message of an error."""
            url = urlsplit(self.path)
            kind = "application/json"
            status = HTTPStatus.OK
            host = self.headers.get("Host", "").lower()
            if not re.fullmatch(r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?", host):
                kind = "text/plain; charset=utf-8"
                status = HTTPStatus.FORBIDDEN
                text = "this server answers to the names localhost and 127.0.0.1 alone\n"
            elif url.path == "/":
                kind = "text/html; charset=utf-8"
                text = page
            else:
                try:
                    text = respond(contents, url.path, dict(parse_qsl(url.query)))
                except Exception as error:  # the page shows it, and the server goes on
                    status = HTTPStatus.BAD_REQUEST
                    text = json.dumps({"error": str(error) or repr(error)})
            data = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            """Requests are not logged: a drag makes many."""

    return ThreadingHTTPServer(("127.0.0.1", port), Handler)


def respond(contents: list[Contents], path: str, query: dict[str, Any]) -> str:
    """The JSON answer to a request; a ``ValueError`` for an unknown path.

    Args:
        contents: Displayed contents of each model.
        path: Kind of the answer.
        query: Values of the URL: ``run``, the number of the contents; ``receiver``, its number;
            ``at``, the new position of a dragged receiver [m]; and ``place`` of a transmitter [m],
            ``height`` of a slice [m], or ``number`` of a test link.
    """
    run = contents[int(query["run"])]
    receiver = int(query.get("receiver", 0))
    position = [float(x) for x in query["at"].split(",")] if "at" in query else None
    match path:
        case "/answer":
            place = [float(x) for x in query["place"].split(",")]
            if position is not None:
                return json.dumps(run.answer_at(place, receiver, position))
            return json.dumps(run.answer(place, receiver))
        case "/slice":
            if position is not None:
                run, receiver = run.moved(receiver, position), 0
            return json.dumps(run.slice(float(query["height"]), receiver))
        case "/comparison":
            return json.dumps(run.comparison(int(query["number"])))
    raise ValueError(f"no answer at {path}")
