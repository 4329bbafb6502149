"""The documentation site: built with warnings as errors, every link leads somewhere, and a browser asks nobody else."""

import os
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

from jaxfit.experiments import read_config

ROOT = Path(__file__).resolve().parents[1]
WIDTHS = (1440, 390)
TEXTS = {"clusters-and-collections"}  # guides whose results are tables
OPENED = (
    *("index", "installing", "method", "limits", "guides/fit-a-folder", "guides/pose", "guides/train", "guides/python"),
    *(
        "reference/models",
        "reference/models/face68",
        "reference/commands",
        "reference/api/index",
        "reference/api/jaxfit",
    ),
    *("measured/index", "measured/speed/speed", "measured/pose-tables/wide/pose", "measured/experiments/report/report"),
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for package in ("sphinx", "furo", "myst_parser"):
        pytest.importorskip(package)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--quiet", "-d", str(folder / "cache")]
    built = subprocess.run(
        [*command, str(ROOT / "docs"), str(folder / "html")],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return folder / "html"


class Page(HTMLParser):
    """What a page has names for, links to, and loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.names: set[str] = {""}
        self.links: set[str] = set()
        self.loads: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value}
        self.names |= {given["id"]} if "id" in given else set()
        links = self.links if tag == "a" else self.loads
        links |= {given[name] for name in ("href", "src", "srcset", "data") if name in given}


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html")}


def test_every_document_is_a_page(site: Path) -> None:
    documents = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    assert documents <= {path.relative_to(site) for path in site.rglob("*.html")}


def test_the_first_page_and_guides_show_pictures(pages: dict[Path, Page], site: Path) -> None:
    guides = {path for path in (site / "guides").glob("*.html") if path.stem not in TEXTS}
    for path in {site / "index.html", *guides}:
        assert any("_images/" in link for link in pages[path].loads), path.name


def test_tables_that_cards_include_are_there(site: Path) -> None:
    text = (site / "reference" / "models" / "face68.html").read_text(encoding="utf-8")
    assert "60 to 90°" in text.partition("Accuracy")[2].partition("<h2>Limits")[0]


def test_every_configuration_can_be_read() -> None:
    configurations = sorted((ROOT / "docs" / "measured" / "experiments").glob("*.toml"))
    assert len(configurations) > 1
    for path in configurations:
        read_config(path)


def test_all_links_lead_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    lost = []
    for path, page in pages.items():
        for link in page.links | page.loads:
            parts = urlsplit(link)
            if parts.scheme:
                assert link in page.links or parts.scheme == "data", f"{path}: {link} is loaded from elsewhere"
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            names = pages[target].names if target in pages else {""}
            if not target.is_file() or unquote(parts.fragment) not in names:
                lost.append(f"{path.relative_to(site)}: {link}")
    assert not lost
    assert sum(len(page.links) for page in pages.values()) > 1000


def test_equations_are_mathml(site: Path) -> None:
    text = (site / "method.html").read_text(encoding="utf-8")
    assert text.count("<math") > 50
    assert "mathjax.js" not in text.lower()


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    class Silent(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=str(site))) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(params=WIDTHS)
def page(browser: Any, address: str, request: pytest.FixtureRequest) -> Iterator[Any]:
    """A tab; when done with it, there must have been no error and no request but to the site."""
    context = browser.new_context(viewport={"width": request.param, "height": 900})
    try:
        page = context.new_page()
        page.set_default_timeout(30_000)
        problems: list[str] = []
        requests: list[str] = []

        def log(message: Any) -> None:
            # Chromium asks for an icon on its own, and logs every answer that is no success.
            if "favicon.ico" not in message.location["url"]:
                problems.append(message.text)

        page.on("console", log)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("requestfailed", lambda failed: problems.append(failed.url))
        page.on("request", lambda request: requests.append(request.url))
        yield page
        assert problems == []
        assert all(url.startswith((address, "data:")) for url in requests)
    finally:
        context.close()


def test_pages_open_without_sideways_scroll(page: Any, address: str, tmp_path: Path) -> None:
    for name in OPENED:
        page.goto(f"{address}{name}.html")
        assert page.locator("article h1").first.is_visible(), name
        shown = page.evaluate("[document.documentElement.scrollWidth, window.innerWidth]")
        assert shown[0] <= shown[1], name
        broken = "[...document.images].filter(image => image.complete && !image.naturalWidth).map(image => image.src)"
        assert page.evaluate(broken) == [], name
        page.screenshot(path=tmp_path / f"{name.replace('/', '-')}.png")


def test_equations_are_drawn(page: Any, address: str) -> None:
    page.goto(f"{address}method.html")
    sizes = page.locator("math").evaluate_all("all => all.map(math => math.getBoundingClientRect().height)")
    assert len(sizes) > 50
    assert min(sizes) > 5
    # A matrix of two rows is drawn as two rows.
    assert page.locator("mtable").first.evaluate("table => table.getBoundingClientRect().height") > 30


def test_the_search_finds(page: Any, address: str) -> None:
    page.goto(f"{address}search.html?q=centroid")
    page.locator("ul.search a", has_text="method").first.wait_for()
