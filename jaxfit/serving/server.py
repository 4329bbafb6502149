"""The HTTP server behind the page: for browsers of this machine only, and for its own page only.

It listens on the loopback interface and keeps what it is sent in memory, for as long as it takes to answer. Web pages
from elsewhere may try to reach it through the user's browser: requests that name another host (as after DNS rebinding),
come from another origin, or lack a header that such pages cannot send, are refused.
"""

import json
import re
import sys
import time
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from importlib import resources
from io import BufferedReader
from socket import SHUT_WR, SocketIO, socket
from socketserver import TCPServer, ThreadingMixIn
from threading import BoundedSemaphore
from typing import Any
from urllib.parse import parse_qs

from jaxfit.errors import ImageError, InputError
from jaxfit.serving.service import Closed, Service

HOST = "127.0.0.1"
MOST_BYTES = 20_000_000  # of a picture's file
TYPES = ("image/jpeg", "image/png", "image/webp", "image/bmp", "image/heic", "image/heif")
_CONNECTIONS = 32  # at once; browsers open six
_PICTURES = 4  # being sent, waiting for their turn or being fitted
_LINGER = 1.0  # seconds that a client who is refused while it sends is given to stop


class Server(ThreadingMixIn, TCPServer):
    """Serves the page and fits the pictures that it sends, in threads, once ``serve_forever`` is called.

    Args:
        service: what fits them.
        port: to listen on; 0 takes any free one.
        seconds: that a client has for sending a request, and for taking the answer.

    Raises:
        InputError: the port is not a number of a port, is taken, or may not be used.
    """

    allow_reuse_address = True  # after a restart, the connections of the one before take a minute to be forgotten
    daemon_threads = True
    request_queue_size = _CONNECTIONS

    def __init__(self, service: Service, port: int = 0, seconds: float = 20.0):
        if not 0 <= port < 2**16:
            raise InputError(f"expected a port between 0 and 65535; got {port}")
        self.service, self.seconds = service, seconds
        self.page = (resources.files(__package__) / "page.html").read_bytes()
        self.policy = _policy(self.page.decode())
        self.pictures = BoundedSemaphore(_PICTURES)
        self._connections = BoundedSemaphore(_CONNECTIONS)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise InputError(
                f"port {port} cannot be used ({error.strerror}); take another, or 0 for any free one"
            ) from None

    @property
    def port(self) -> int:
        """The one that it listens on."""
        return self.server_address[1]

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{HOST}:{self.port}/"

    @property
    def hosts(self) -> tuple[str, ...]:
        """The names by which browsers address this server."""
        names = (HOST, "localhost")
        return tuple(f"{name}:{self.port}" for name in names) + (names if self.port == 80 else ())

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, unless there are too many already."""
        if self._connections.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._connections.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print what went wrong, unless the client went away."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


def _policy(page: str) -> str:
    """What the page may do: run its own script, look as it says, show the user's pictures and ask this server."""
    hashes = {
        tag: " ".join(
            f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"
            for text in re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        )
        for tag in ("script", "style")
    }
    return (
        f"default-src 'none'; script-src {hashes['script']}; style-src {hashes['style']}; img-src blob: data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class _Refusal(Exception):
    """Why a request is not answered as it wishes, and the status that says so."""

    def __init__(self, status: HTTPStatus, why: str):
        super().__init__(why)
        self.status = status


class _Incoming(SocketIO):
    """What a client sends, if all of it comes in time: one byte now and then would keep a thread busy for ever."""

    def __init__(self, connection: socket, seconds: float):
        super().__init__(connection, "r")
        self._connection, self._end = connection, time.monotonic() + seconds

    def readinto(self, buffer: Any) -> int | None:
        """Wait for more, at most until the end.

        Raises:
            TimeoutError: the end has come.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request did not come in time")
        self._connection.settimeout(left)
        return super().readinto(buffer)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request; errors are JSON, ``{"error": why}``."""

    server: Server
    server_version, sys_version = "jaxfit", ""

    def setup(self) -> None:
        """Give the client its time."""
        super().setup()
        self.rfile = BufferedReader(_Incoming(self.connection, self.server.seconds))
        self._unread = False

    def finish(self) -> None:
        """Let a client that is still sending read its answer: closing at once would take it away again."""
        super().finish()
        if self._unread:
            incoming = BufferedReader(_Incoming(self.connection, _LINGER))
            with suppress(OSError):  # it is gone, or does not stop
                self.connection.shutdown(SHUT_WR)
                while incoming.read1(2**16):
                    pass

    def do_GET(self) -> None:
        """The page, and what it may choose from."""
        self._answer(
            {
                "/": lambda: self._send(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page),
                "/options": lambda: self._send_json(HTTPStatus.OK, self._options()),
            }
        )

    def do_POST(self) -> None:
        """The faces in a picture."""
        self._unread = True
        self._answer({"/fit": self._fit})

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Say what is wrong with a request, as JSON; the standard library's own complaints come here too."""
        self._send_json(HTTPStatus(code), {"error": message or HTTPStatus(code).phrase})

    def log_message(self, format: str, *args: Any) -> None:
        """Be quiet."""

    def _answer(self, actions: dict[str, Callable[[], None]]) -> None:
        """Do what the path stands for, or say why not."""
        try:
            if self.headers.get("Host") not in self.server.hosts:
                raise _Refusal(HTTPStatus.FORBIDDEN, f"expected to be called {' or '.join(self.server.hosts)}")
            path = self.path.partition("?")[0]
            if path not in actions:
                raise _Refusal(HTTPStatus.NOT_FOUND, f"nothing to {self.command} at {path}")
            actions[path]()
        except _Refusal as refusal:
            self.send_error(refusal.status, str(refusal))
        except (ConnectionError, TimeoutError):  # the client went away
            raise
        except Exception:
            self.server.handle_error(self.request, self.client_address)
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, "something is wrong with jaxfit; its terminal says more")

    def _options(self) -> dict[str, Any]:
        return self.server.service.options() | {"types": TYPES, "most_bytes": MOST_BYTES}

    def _fit(self) -> None:
        self._require_own_page()
        length = self._length()
        if not self.server.pictures.acquire(blocking=False):
            raise _Refusal(HTTPStatus.SERVICE_UNAVAILABLE, "busy with other pictures; try again")
        try:
            data = self._body(length)
            asked = parse_qs(self.path.partition("?")[2])
            found = self.server.service.fit(data, *(asked.get(name, [""])[0] for name in ("model", "detector")))
        except InputError as error:
            raise _Refusal(HTTPStatus.BAD_REQUEST, str(error)) from None
        except ImageError as error:
            raise _Refusal(HTTPStatus.UNPROCESSABLE_ENTITY, str(error)) from None
        except Closed as error:
            raise _Refusal(HTTPStatus.SERVICE_UNAVAILABLE, str(error)) from None
        finally:
            self.server.pictures.release()
        self._send_json(HTTPStatus.OK, found)

    def _require_own_page(self) -> None:
        """Refuse what the pages of other sites send: they cannot set the header, nor hide their origin."""
        origin = self.headers.get("Origin")
        own = origin is None or origin in {f"http://{host}" for host in self.server.hosts}
        if not own or self.headers.get("X-Jaxfit") != "1":
            raise _Refusal(HTTPStatus.FORBIDDEN, "expected the header X-Jaxfit: 1, and no other site's Origin")

    def _length(self) -> int:
        """Of the picture, if it may be sent."""
        length = self.headers.get("Content-Length", "")
        if "Transfer-Encoding" in self.headers or not re.fullmatch(r"[0-9]{1,18}", length):
            raise _Refusal(HTTPStatus.LENGTH_REQUIRED, "expected a Content-Length, and no Transfer-Encoding")
        if int(length) > MOST_BYTES:
            most = MOST_BYTES // 1_000_000
            raise _Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected a picture of at most {most} MB")
        if self.headers.get("Content-Type") not in TYPES:
            raise _Refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"expected a Content-Type among {', '.join(TYPES)}")
        return int(length)

    def _body(self, length: int) -> bytes:
        try:
            data = self.rfile.read(length)
        except TimeoutError:
            raise _Refusal(HTTPStatus.REQUEST_TIMEOUT, "the picture did not come in time") from None
        if len(data) < length:
            raise _Refusal(HTTPStatus.BAD_REQUEST, f"expected {length} bytes; got {len(data)}")
        self._unread = False
        return data

    def _send_json(self, status: HTTPStatus, value: Any) -> None:
        self._send(status, "application/json", json.dumps(value).encode())

    def _send(self, status: HTTPStatus, kind: str, data: bytes) -> None:
        self.connection.settimeout(self.server.seconds)
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(data))),
            ("Content-Security-Policy", self.server.policy),
            ("Permissions-Policy", "camera=(self), microphone=(), geolocation=()"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)
