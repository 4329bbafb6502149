"""The server of `jaxfit serve`: what it answers, what it refuses and how, and that it keeps nothing."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np
import pytest

import jaxfit
from jaxfit.data.detectors import detector_named
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Problem
from jaxfit.schemes.known import IBUG68
from jaxfit.serving import Server, Service, service
from jaxfit.serving.server import MOST_BYTES

WAIT = 60.0  # seconds, for answers that should come
NOTHING: dict = {"width": 1, "height": 1, "faces": [], "problems": []}
FIT = "/fit?model=fast68&detector=whole"


def encoded(suffix: str = ".jpg", shape: tuple[int, ...] = (90, 80, 3)) -> bytes:
    pixels = np.random.default_rng(8).integers(0, 256, shape).astype(np.uint8)
    return cv2.imencode(suffix, cv2.GaussianBlur(pixels, (0, 0), 5))[1].tobytes()


@pytest.fixture(scope="module")
def portrait_file() -> Path:
    cbook = pytest.importorskip("matplotlib.cbook")
    return Path(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


def make_service() -> Service:
    models = {name: jaxfit.load(name) for name in ("fast68", "regression68-3d")}
    return Service(models, {name: detector_named(name) for name in ("yunet", "whole")})


@contextmanager
def serving(service: Service, seconds: float = 20.0) -> Iterator[Server]:
    with Server(service, seconds=seconds) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            service.close()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(make_service()) as running:
        yield running


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Callable:
    """Servers that fit as the test says, and with deadlines as short as it says."""

    @contextmanager
    def serve(fitted: Callable = lambda *_: NOTHING, **options: Any) -> Iterator[Server]:
        monkeypatch.setattr(service, "_fitted", fitted)
        with serving(make_service(), **options) as running:
            yield running

    return serve


def ask(
    server: Server, method: str = "GET", path: str = "/", body: bytes | None = None, **headers: str | None
) -> tuple[int, Any, http.client.HTTPMessage]:
    """Status, answer and headers; a header of None is not sent, in the names ``_`` stands for ``-``."""
    usual = {"Host": f"127.0.0.1:{server.port}"}
    if method == "POST":
        usual |= {"Content-Type": "image/jpeg", "X-Jaxfit": "1", "Content-Length": str(len(body or b""))}
    sent = usual | {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=WAIT)
    try:
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in sent.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        response = connection.getresponse()
        data = response.read()
    finally:
        connection.close()
    json_sent = response.headers["Content-Type"] == "application/json"
    return response.status, json.loads(data) if json_sent else data, response.headers


def raw(server: Server, data: bytes) -> bytes:
    """All that comes back."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=WAIT) as connection:
        connection.sendall(data)
        return b"".join(iter(lambda: connection.recv(2**16), b""))


@pytest.mark.parametrize("model", ["fast68", "regression68-3d"])
def test_answers_are_the_fits(server: Server, portrait_file: Path, model: str) -> None:
    status, answer, _ = ask(server, "POST", f"/fit?model={model}&detector=yunet", portrait_file.read_bytes())
    fits = jaxfit.fit(jaxfit.load(model), [jaxfit.read_image(portrait_file)])
    assert status == 200
    assert [answer["width"], answer["height"], answer["problems"]] == [512, 600, []]
    (face,) = answer["faces"]
    assert face["size"] == {"width": 512, "height": 600}
    assert face["box"].pop("kind") == "yunet"
    assert list(face["box"]) == ["x", "y", "width", "height", "rotation"]
    np.testing.assert_allclose(list(face["box"].values()), [*fits.boxes[0], fits.rotations[0]], atol=1e-3)
    np.testing.assert_allclose(face["landmarks"], fits.landmarks[0], atol=0.05)
    if fits.pose is None or fits.landmarks_3d is None or fits.scale is None:
        assert face.keys() == {"size", "box", "ok", "landmarks", "openness"}
    else:
        in_3d = {"pose", "scale", "landmarks_3d", "b", "outline"}
        assert face.keys() == {"size", "box", "ok", "landmarks", "openness"} | in_3d
        np.testing.assert_allclose(face["landmarks_3d"], fits.landmarks_3d[0], atol=0.05)
        assert list(face["pose"]) == ["roll", "pitch", "yaw"]
        np.testing.assert_allclose(list(face["pose"].values()), fits.pose[0], atol=0.05)
        np.testing.assert_allclose(face["scale"], fits.scale[0], rtol=1e-2)
        corners = np.array(face["outline"]["corners"])
        assert (corners.min(0) < fits.landmarks_3d[0].min(0)).all()
        assert (corners.max(0) > fits.landmarks_3d[0].max(0)).all()


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".bmp"])
def test_pictures_of_all_types(server: Server, suffix: str) -> None:
    kind = {".jpg": "jpeg"}.get(suffix, suffix[1:])
    status, answer, _ = ask(server, "POST", FIT, encoded(suffix), Content_Type=f"image/{kind}")
    assert (status, answer["width"], answer["height"], len(answer["faces"])) == (200, 80, 90, 1)


@pytest.mark.skipif(find_spec("pillow_heif") is not None, reason="HEIC can be read here")
def test_heic_says_what_reads_it(server: Server) -> None:
    heic = b"\0\0\0\x18ftypheic" + bytes(100)
    status, answer, _ = ask(server, "POST", FIT, heic, Content_Type="image/heic")
    assert status == 422
    assert 'pip install "jaxfit[heif]"' in answer["error"]


def test_a_picture_without_a_face_is_no_error(server: Server) -> None:
    status, answer, _ = ask(server, "POST", "/fit?model=fast68&detector=yunet", encoded())
    assert (status, answer) == (200, {"width": 80, "height": 90, "faces": [], "problems": []})


def test_confidence_and_faces_that_were_not_fitted(quick: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    landmarks = np.ones((3, 68, 2))
    landmarks[2] = np.nan
    fits = jaxfit.Fits(
        scheme=IBUG68,
        names=("",),
        sizes=np.array([[80, 90]]),
        pictures=np.zeros(3, int),
        boxes=np.full((3, 4), 10.0),
        kinds=("whole",) * 3,
        rotations=np.zeros(3),
        landmarks=landmarks,
        problems=(Problem(0, "", "no face found"), Problem(0, "", "the fit diverged", 2)),
        confidence=np.array([0.1, 0.98765, np.nan]),
    )
    monkeypatch.setattr(service, "fit", lambda *_, **__: fits)
    with quick(service._fitted) as server:
        status, answer, _ = ask(server, "POST", FIT, encoded())
    assert status == 200
    assert [face["confidence"] for face in answer["faces"]] == [0.1, 0.988]
    assert answer["problems"] == ["the fit diverged"]


def test_the_page_may_do_only_what_it_needs(server: Server) -> None:
    status, page, headers = ask(server)
    assert status == 200
    assert page.startswith(b"<!DOCTYPE html>")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == policy["frame-ancestors"] == "'none'"
    assert policy["connect-src"] == "'self'"
    assert all(policy[f"{part}-src"].startswith("'sha256-") for part in ("script", "style"))
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Cache-Control"] == "no-store"
    assert headers["Access-Control-Allow-Origin"] is None
    assert b"http://" not in page
    assert b"https://" not in page


def test_options(server: Server) -> None:
    _, options, _ = ask(server, path="/options")
    assert [(model["name"], model["solid"]) for model in options["models"]] == [
        ("fast68", False),
        ("regression68-3d", True),
    ]
    assert options["models"][0]["landmarks"] == 68
    assert max(index for points in options["models"][0]["lines"] for index in points) == 67
    assert options["detectors"] == ["yunet", "whole"]
    assert options["most_bytes"] == MOST_BYTES


def promised(width: int, height: int) -> bytes:
    """A PNG of a few bytes that says it has so many pixels."""
    data = encoded(".png")
    return data[:16] + width.to_bytes(4, "big") + height.to_bytes(4, "big") + data[24:]


OTHER = "evil.example"
REFUSED: dict[str, tuple[int, str, str, bytes | None, dict[str, Any]]] = {
    "another host": (403, "GET", "/", None, {"Host": OTHER}),
    "another port": (403, "GET", "/options", None, {"Host": "localhost:1"}),
    "no host": (403, "GET", "/", None, {"Host": None}),
    "picture for another host": (403, "POST", FIT, encoded(), {"Host": OTHER}),
    "another site": (403, "POST", FIT, encoded(), {"Origin": f"https://{OTHER}"}),
    "an opaque site": (403, "POST", FIT, encoded(), {"Origin": "null"}),
    "no own header": (403, "POST", FIT, encoded(), {"X-Jaxfit": None}),
    "no such page": (404, "GET", "/etc/passwd", None, {}),
    "nothing above": (404, "GET", "/../server.py", None, {}),
    "get fit": (404, "GET", FIT, None, {}),
    "post page": (404, "POST", "/", encoded(), {}),
    "no length": (411, "POST", FIT, None, {"Content-Length": None}),
    "negative length": (411, "POST", FIT, None, {"Content-Length": "-1"}),
    "chunked": (411, "POST", FIT, None, {"Transfer-Encoding": "chunked"}),
    "too large": (413, "POST", FIT, None, {"Content-Length": str(MOST_BYTES + 1)}),
    "enormous": (413, "POST", FIT, None, {"Content-Length": "9" * 18}),
    "another type": (415, "POST", FIT, encoded(), {"Content-Type": "image/tiff"}),
    "no type": (415, "POST", FIT, encoded(), {"Content-Type": None}),
    "empty": (422, "POST", FIT, b"", {}),
    "garbage": (422, "POST", FIT, b"x" * 999, {}),
    "truncated": (422, "POST", FIT, encoded()[:-9], {}),
    "another format": (422, "POST", FIT, encoded(".tif"), {}),
    "too many pixels": (422, "POST", FIT, promised(50_000, 50_000), {}),
    "no model": (400, "POST", "/fit?detector=whole", encoded(), {}),
    "another model": (400, "POST", "/fit?model=/etc/passwd&detector=whole", encoded(), {}),
    "another detector": (400, "POST", "/fit?model=fast68&detector=dlib", encoded(), {}),
    "another method": (501, "PUT", FIT, None, {}),
    "preflight": (501, "OPTIONS", FIT, None, {"Origin": f"https://{OTHER}"}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(server: Server, case: str) -> None:
    expected, method, path, body, headers = REFUSED[case]
    status, answer, sent = ask(server, method, path, body, **headers)
    assert status == expected
    assert answer.keys() == {"error"}
    assert len(answer["error"]) > 5
    assert sent["Access-Control-Allow-Origin"] is None


def test_its_own_names(server: Server) -> None:
    for name in ("localhost", "127.0.0.1"):
        host = f"{name}:{server.port}"
        assert ask(server, "POST", FIT, encoded(), Host=host, Origin=f"http://{host}")[0] == 200


def test_a_refused_client_that_sends_all_the_same_reads_why(server: Server) -> None:
    assert ask(server, "POST", FIT, bytes(MOST_BYTES + 1))[0] == 413
    assert ask(server, "POST", FIT, bytes(MOST_BYTES), Content_Type="text/plain")[0] == 415


@pytest.mark.parametrize(
    "line", [b"\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"\x16\x03\x01" + bytes(99) + b"\n"]
)
def test_what_is_no_http(server: Server, line: bytes) -> None:
    answer = raw(server, line + b"\n")
    assert not answer or b" 505 " in answer or b'{"error"' in answer
    assert ask(server)[0] == 200


def test_long_headers(server: Server) -> None:
    assert b" 414 " in raw(server, b"GET /" + b"a" * 70_000)[:99]
    assert b" 431 " in raw(server, b"GET / HTTP/1.0\r\n" + b"A: b\r\n" * 200)[:99]


def test_only_the_loopback_interface_listens(server: Server) -> None:
    assert server.socket.getsockname()[0] == "127.0.0.1"


def post(server: Server, length: int) -> bytes:
    """A request with a picture, but for the picture."""
    lines = [f"POST {FIT} HTTP/1.0", f"Host: localhost:{server.port}", "X-Jaxfit: 1", "Content-Type: image/jpeg"]
    return "\r\n".join([*lines, f"Content-Length: {length}", "", ""]).encode()


def drip(server: Server, first: bytes) -> bytes:
    """What comes back when a byte is sent now and then; ends when the server ends it."""
    came = b""
    with socket.create_connection(("127.0.0.1", server.port), timeout=0.05) as connection:
        connection.sendall(first)
        until = time.monotonic() + WAIT
        while time.monotonic() < until:
            with suppress(TimeoutError):
                part = connection.recv(2**16)
                if not part:
                    return came
                came += part
            with suppress(BrokenPipeError):
                connection.sendall(b"x")
    raise AssertionError("still open")


def test_slow_clients_are_let_go(quick: Callable) -> None:
    with quick(seconds=0.4) as server, suppress(ConnectionResetError):
        assert drip(server, b"GET / HTTP/1.0\r\nX") == b""
    start = (
        f"POST {FIT} HTTP/1.0\r\nX-Jaxfit: 1\r\nContent-Type: image/jpeg\r\nContent-Length: 999999\r\nHost: localhost:"
    )
    with quick(seconds=0.4) as server:
        assert b" 408 " in drip(server, f"{start}{server.port}\r\n\r\n".encode())
        assert ask(server, "POST", FIT, encoded())[0] == 200


def test_half_a_picture(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=WAIT) as connection:
        connection.sendall(post(server, 99) + b"xxx")
        connection.shutdown(socket.SHUT_WR)
        assert b" 400 " in connection.recv(2**16)


def test_one_picture_at_a_time_and_few_wait(quick: Callable) -> None:
    go, running, most = Event(), [0], [0]

    def fitted(*_: object) -> dict:
        running[0] += 1
        most[0] = max(most[0], running[0])
        go.wait(WAIT)
        running[0] -= 1
        return NOTHING

    with quick(fitted) as server, ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(ask, server, "POST", FIT, encoded()) for _ in range(8)]
        until = time.monotonic() + WAIT
        while sum(each.done() for each in asked) < 4 and time.monotonic() < until:
            time.sleep(0.01)
        refused = [each.result() for each in asked if each.done()]
        assert [status for status, *_ in refused] == [503] * 4
        assert ask(server)[0] == 200  # the page still comes
        go.set()
        assert sorted(each.result()[0] for each in asked) == [200] * 4 + [503] * 4
        assert most == [1]
        assert ask(server, "POST", FIT, encoded())[0] == 200


def test_memory_does_not_grow_with_requests(quick: Callable) -> None:
    """Answered, refused and broken ones."""
    psutil = pytest.importorskip("psutil")
    bodies = (encoded(), b"garbage", encoded()[:-9], promised(50_000, 50_000), bytes(2_000_000))

    def some(server: Server, count: int) -> int:
        for number in range(count):
            ask(server, "POST", FIT, bodies[number % len(bodies)])
        return psutil.Process().memory_info().rss

    with quick() as server:
        before = some(server, 50)
        assert some(server, 450) - before < 30 << 20


def test_idle_connections_do_not_pile_up(server: Server) -> None:
    idle = [socket.create_connection(("127.0.0.1", server.port), timeout=WAIT) for _ in range(33)]
    try:
        assert idle[-1].recv(1) == b""  # one too many
    finally:
        for connection in idle:
            connection.close()
    until = time.monotonic() + WAIT
    while time.monotonic() < until:
        with suppress(ConnectionError):
            assert ask(server)[0] == 200
            return
    raise AssertionError("no connection is free again")


def test_our_own_mistakes_are_told_apart(quick: Callable, capsys: pytest.CaptureFixture[str]) -> None:
    def fitted(*_: object) -> dict:
        raise RuntimeError("a bug")

    with quick(fitted) as server:
        status, answer, _ = ask(server, "POST", FIT, encoded())
        assert (status, list(answer)) == (500, ["error"])
        assert "a bug" not in answer["error"]
        assert ask(server)[0] == 200
    assert "RuntimeError: a bug" in capsys.readouterr().err


def test_after_the_end_nothing_is_fitted(quick: Callable) -> None:
    with quick() as server:
        server.service.close()
        assert ask(server, "POST", FIT, encoded())[0] == 503


def test_nothing_is_written(
    server: Server, portrait_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    opened: list[object] = []

    def watch(event: str, arguments: tuple) -> None:
        # A number is that of a file that is open already, and in memory.
        if event == "open" and isinstance(arguments[2], int) and not isinstance(arguments[0], int):
            opened.extend([arguments[0]] if arguments[2] & (os.O_WRONLY | os.O_RDWR) else [])

    sys.addaudithook(lambda event, arguments: watch(event, arguments) if listening else None)
    listening = True
    try:
        for data in (portrait_file.read_bytes(), encoded(), b"garbage", encoded()[:-9], bytes(MOST_BYTES)):
            ask(server, "POST", "/fit?model=fast68&detector=yunet", data)
    finally:
        listening = False
    assert opened == []
    assert list(tmp_path.iterdir()) == []


def test_what_the_page_begins_with_is_compiled_first(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[object] = []

    def fitted(*_: object) -> dict:
        done.append("picture")
        return NOTHING

    monkeypatch.setattr(service, "warm_up", lambda model, **how: done.append((model, how)))
    monkeypatch.setattr(service, "_fitted", fitted)
    models = {"first": jaxfit.load("regression68-3d"), "second": jaxfit.load("fast68")}
    fitting = Service(models, {"yunet": detector_named("yunet")})
    fitting.warm_up()
    assert fitting.fit(encoded(), "second", "yunet") == NOTHING
    assert done == [(models["first"], {"batches": (1,), "passes": 1}), "picture"]
    fitting.close()


def test_wrong_arguments(server: Server) -> None:
    with pytest.raises(InputError, match=rf"port {server.port} cannot be used"):
        Server(server.service, server.port)
    with pytest.raises(InputError, match="between 0 and 65535; got 65536"):
        Server(server.service, 65536)
    with pytest.raises(InputError, match="0 and 1"):
        Service({}, {"yunet": detector_named("yunet")})


# Shells have their background jobs, and all that these start, ignore Ctrl-C.
HEARS_CTRL_C = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from jaxfit.cli.main import main; sys.exit(main())"
)


def command(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", HEARS_CTRL_C, "serve", "--no-browser", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent as POSIX does")
def test_the_command_serves_until_it_is_stopped() -> None:
    with command("--model", "fast68") as running:
        assert running.stdout is not None
        words = running.stdout.readline().split()
        assert words[:3] == ["jaxfit", "is", "at"]
        port = int(words[3].rstrip("/").rpartition(":")[2])
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT)
        connection.request("GET", "/options")
        assert [model["name"] for model in json.load(connection.getresponse())["models"]] == ["fast68"]
        connection.close()
        running.send_signal(signal.SIGINT)
        try:
            out, err = running.communicate(timeout=WAIT)
        finally:
            running.kill()
    assert (running.returncode, out.split(), err) == (0, ["stopped"], "")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--model", "fast68", "fast68"), "each name once"),
        (("--model", "none"), "none"),
        (("--model", "fast68", "--port", "99999"), "port"),
    ],
)
def test_wrong_commands(arguments: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    from jaxfit.cli.main import main

    assert main(["serve", "--no-browser", *arguments]) == 2
    assert reason in capsys.readouterr().err
