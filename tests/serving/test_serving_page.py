"""The page of `jaxfit serve` in a real browser: pictures dropped, results drawn and taken away, and what goes wrong."""

import base64
import csv
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

import jaxfit
from jaxfit.data.detectors import detector_named
from jaxfit.serving import Server, Service

DROP = """([name, type, data]) => {
  const bytes = Uint8Array.from(atob(data), letter => letter.charCodeAt(0));
  const transfer = new DataTransfer();
  transfer.items.add(new File([bytes], name, { type }));
  document.getElementById("view").dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true }));
}"""
# The share of the canvas that is drawn in about the colour of 2D landmarks.
CYAN_SHARE = """canvas => {
  const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let at = 0; at < data.length; at += 4)
    count += Math.abs(data[at] - 23) + Math.abs(data[at + 1] - 224) + Math.abs(data[at + 2] - 242) < 60;
  return count * 4 / data.length;
}"""


@pytest.fixture(scope="module")
def portrait_file() -> Path:
    cbook = pytest.importorskip("matplotlib.cbook")
    return Path(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@contextmanager
def running(port: int = 0) -> Iterator[Server]:
    models = {name: jaxfit.load(name) for name in ("fast68", "regression68-3d")}
    service = Service(models, {name: detector_named(name) for name in ("yunet", "whole")})
    with Server(service, port) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            service.close()


@pytest.fixture(scope="module")
def server(browser: Any) -> Iterator[Server]:
    with running() as server:
        yield server


@pytest.fixture
def opened(browser: Any) -> Callable:
    """Opens the page; when done with it, there must have been no error and no request but to its server."""

    @contextmanager
    def show(server: Server, width: int = 1280, height: int = 900, **options: Any) -> Iterator[Any]:
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        try:
            page = context.new_page()
            page.set_default_timeout(30_000)
            problems: list[str] = []
            requests: list[str] = []
            page.on("console", lambda message: problems.append(message.text))
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.on("request", lambda request: requests.append(request.url))
            page.goto(server.address)
            page.get_by_text("Ready").wait_for()
            yield page
            # Chromium tells of every answer that is no success, and of servers that are gone.
            assert [text for text in problems if not text.startswith("Failed to load resource")] == []
            assert all(url.startswith((server.address, "blob:", "data:")) for url in requests)
        finally:
            context.close()

    return show


def choose(page: Any, *files: object) -> None:
    page.locator("#files").set_input_files(files)


def rows(page: Any) -> list[list[str]]:
    page.locator("#faces tbody tr").first.wait_for()
    return [row.locator("td").all_text_contents() for row in page.locator("#faces tbody tr").all()]


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_dropped_picture_is_fitted_and_drawn(
    server: Server, opened: Callable, portrait_file: Path, tmp_path: Path, width: int, scheme: str
) -> None:
    with opened(server, width, color_scheme=scheme) as page:
        assert page.locator("#side").is_hidden()
        data = base64.b64encode(portrait_file.read_bytes()).decode()
        page.evaluate(DROP, ["portrait.jpg", "image/jpeg", data])
        page.get_by_text("1 face in portrait.jpg").wait_for()
        ((number, across, _, confidence),) = rows(page)
        fits = jaxfit.fit(jaxfit.load("fast68"), [jaxfit.read_image(portrait_file)])
        assert (number, across, confidence) == ("1", f"{round(fits.boxes[0, 2])} px", "–")
        canvas = page.locator("#canvas")
        assert canvas.evaluate(CYAN_SHARE) > 0.001
        box = canvas.bounding_box()
        assert box["width"] / box["height"] == pytest.approx(512 / 600, rel=0.02)
        page.get_by_label("Landmarks").uncheck()
        assert canvas.evaluate(CYAN_SHARE) < 0.0005
        assert page.locator("#solid").is_hidden()
        assert page.evaluate("document.documentElement.scrollWidth") == width
        page.screenshot(path=tmp_path / "page.png", full_page=True)
        assert (tmp_path / "page.png").stat().st_size > 10_000


def test_heads_have_poses_and_turn(server: Server, opened: Callable, portrait_file: Path) -> None:
    with opened(server) as page:
        choose(page, portrait_file)
        rows(page)
        page.get_by_label("Model").select_option("regression68-3d")
        page.locator("#solid").wait_for()
        heads = page.locator("#faces thead th").all_text_contents()
        assert heads == ["Face", "Roll", "Pitch", "Yaw", "Confidence"]
        ((_, *angles, _),) = rows(page)
        fits = jaxfit.fit(jaxfit.load("regression68-3d"), [jaxfit.read_image(portrait_file)])
        shown = np.array([float(angle.replace("−", "-").rstrip("°")) for angle in angles])
        assert fits.pose is not None
        np.testing.assert_allclose(shown, fits.pose[0], atol=0.11)
        turntable = page.locator("#turntable")
        before = turntable.evaluate("canvas => canvas.toDataURL()")
        turntable.focus()
        page.keyboard.press("ArrowRight")
        aside = turntable.evaluate("canvas => canvas.toDataURL()")
        page.keyboard.press("Home")
        assert aside != before == turntable.evaluate("canvas => canvas.toDataURL()")
        turntable.hover()
        page.mouse.down()
        page.mouse.move(1100, 500, steps=3)
        page.mouse.up()
        assert turntable.evaluate("canvas => canvas.toDataURL()") != before


def test_several_faces_and_how_sure_the_model_is(
    server: Server, opened: Callable, portrait_file: Path, tmp_path: Path
) -> None:
    with opened(server) as page:
        page.get_by_label("Model").select_option("regression68-3d")

        def answer(route: Any) -> None:
            found = route.fetch().json()
            (face,) = found["faces"]
            moved = face | {
                "landmarks": [[x + 150, y + 40] for x, y in face["landmarks"]],
                "confidence": 0.314,
                "ok": False,
            }
            route.fulfill(json=found | {"faces": [face | {"confidence": 0.987}, moved]})

        page.route("**/fit?*", answer)
        choose(page, portrait_file)
        page.get_by_text("2 faces in grace_hopper.jpg").wait_for()
        assert [row[-1] for row in rows(page)] == ["0.99", "0.31"]
        assert page.locator(".doubtful").all_text_contents() == ["0.31"]
        assert page.get_by_text("Confidence is the probability of a good fit.").is_visible()
        second = page.get_by_role("button", name="Face 2")
        assert second.get_attribute("aria-pressed") == "false"
        second.click()
        assert second.get_attribute("aria-pressed") == "true"
        assert page.locator("#turntable").get_attribute("aria-label").startswith("The 3D shape of face 2")
        page.screenshot(path=tmp_path / "faces.png")


def test_wrong_pictures_do_not_stop_the_others(
    server: Server, opened: Callable, portrait_file: Path, tmp_path: Path
) -> None:
    damaged = {"name": "damaged.jpg", "mimeType": "image/jpeg", "buffer": portrait_file.read_bytes()[:-900]}
    film = {"name": "film.mp4", "mimeType": "video/mp4", "buffer": b"x"}
    empty = tmp_path / "a=b, c.png"
    jaxfit.data.pictures.write_image(empty, np.full((90, 120, 3), 90, np.uint8))
    with opened(server) as page:
        page.locator("#files").set_input_files([damaged, film])
        page.get_by_text("The file is truncated").wait_for()
        choose(page, empty, portrait_file)
        strip = page.locator("#pictures")
        strip.get_by_text("1 face", exact=True).wait_for()
        states = [button.locator("span").all_text_contents() for button in strip.get_by_role("button").all()]
        assert states == [
            ["damaged.jpg", "failed"],
            ["film.mp4", "failed"],
            ["a=b, c.png", "no face found"],
            ["grace_hopper.jpg", "1 face"],
        ]
        assert page.get_by_role("status").text_content().startswith("No face found")
        strip.get_by_role("button").nth(1).click()
        assert page.get_by_role("status").text_content() == "Expected a JPEG, PNG, WebP or BMP picture"
        with page.expect_download() as event:
            page.get_by_role("button", name="Save JSON").click()
        saved = json.loads(event.value.path().read_text(encoding="utf-8"))
        assert ["error" in one or len(one["faces"]) for one in saved] == [True, True, 0, 1]
        with page.expect_download() as event:
            page.get_by_role("button", name="Save CSV").click()
        with open(event.value.path(), encoding="utf-8", newline="") as file:
            (row,) = csv.DictReader(file)
        assert (row["image"], row["face"], row["box"]) == ("grace_hopper.jpg", "1", "yunet")
        landmarks = [[float(row[f"{axis}{i}"]) for axis in "xy"] for i in range(1, 69)]
        np.testing.assert_allclose(landmarks, saved[3]["faces"][0]["landmarks"])
        page.get_by_role("button", name="Remove all").click()
        assert page.get_by_text("Drop pictures here").is_visible()
        assert page.locator("#side").is_hidden()


def test_everything_is_within_reach_of_the_keyboard(server: Server, opened: Callable, portrait_file: Path) -> None:
    with opened(server) as page:
        page.on("filechooser", lambda chooser: None)  # asks Chromium for them now: the key would come too early
        page.locator("body").press("Tab")
        assert page.evaluate("document.activeElement.id") == "choose"
        with page.expect_file_chooser() as event:
            page.keyboard.press("Enter")
        event.value.set_files(portrait_file)
        rows(page)
        reached = []
        for _ in range(14):
            reached.append(page.evaluate("document.activeElement.id || document.activeElement.textContent"))
            page.keyboard.press("Tab")
        ids = ["choose", "camera", "model", "detector", "show-landmarks", "show-box", "1", "json", "csv", "clear"]
        assert [name for name in reached if name in ids][: len(ids)] == ids


def test_the_webcam(server: Server, opened: Callable) -> None:
    with opened(server) as page:
        page.get_by_label("Faces found by").select_option("whole")
        page.get_by_role("button", name="Use webcam").click()
        page.get_by_role("status").get_by_text("1 face").wait_for()
        page.get_by_role("button", name="Face 1").focus()
        for _ in range(3):  # frame after frame
            with page.expect_response(lambda response: "/fit" in response.url) as event:
                pass
            assert event.value.status == 200
        assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Face 1"
        page.get_by_role("button", name="Stop webcam").click()
        assert page.get_by_text("Drop pictures here").is_visible()
        assert page.get_by_role("status").text_content() == "Ready"


def test_a_refused_webcam_is_said(server: Server, opened: Callable) -> None:
    with opened(server) as page:
        page.evaluate(
            "() => { const no = new DOMException('no', 'NotAllowedError');"
            "navigator.mediaDevices.getUserMedia = () => Promise.reject(no); }"
        )
        page.get_by_role("button", name="Use webcam").click()
        page.get_by_text("The browser may not use the camera").wait_for()


def test_a_server_that_is_gone_comes_back(opened: Callable, portrait_file: Path) -> None:
    with running() as server:
        port = server.port
        show = opened(server)
        page = show.__enter__()
    try:
        choose(page, portrait_file)
        page.get_by_role("alert").get_by_text("The server does not answer").wait_for()
        with running(port):
            page.get_by_role("button", name="Try again").click()
            assert len(rows(page)) == 1
            assert page.get_by_role("alert").is_hidden()
    finally:
        show.__exit__(None, None, None)
