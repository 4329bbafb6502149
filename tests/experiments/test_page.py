"""A report's files: tables that can be read back, figures, and a page that works in a real browser, with no network."""

import csv
import json
import math
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np
import pytest

from jaxfit.errors import InputError
from jaxfit.evaluation.plots import plot_ced, plot_pose_surface
from jaxfit.evaluation.pose import PoseGrid
from jaxfit.experiments.latex import latex_table
from jaxfit.experiments.page import write_files
from jaxfit.experiments.report_parts import Gallery, GalleryFace, Report, ReportFigure, ReportTable, Section
from jaxfit.experiments.svg import inline_svg
from jaxfit.schemes.known import IBUG68

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.figure

pytest.importorskip("jinja2")
PartKind = TypeVar("PartKind", ReportTable, ReportFigure)
METHODS = ("SDM", "parametric", "3D alignment")
SIDE = 96
# What breaks pages whose texts are not escaped.
HOSTILE = "</script><script>document.title = 'broken'</script>&amp;\"'"


def grid_table(name: str, title: str, rng: np.random.Generator) -> ReportTable:
    steps = range(1, 8)
    rows = tuple(
        {
            "augmentations": count,
            **{str(step): 0.16 * np.exp(-step / 3) + 0.07 + rng.normal(0, 0.002) for step in steps},
        }
        for count in (1, 5, 10, 15, 20, 25)
    )
    return ReportTable(
        name, title, {"augmentations": "", **{str(step): ".4f" for step in steps}}, rows, "Mean NMED over faces."
    )


def comparison_table() -> ReportTable:
    rows = (
        {"method": "SDM", "faces": 836, "mean": 0.07631, "± 95 %": 0.0021, "text": "0.0763 ± 0.0021", "p": None},
        {"method": "parametric", "faces": 836, "mean": 0.1 / 3, "± 95 %": 0.002, "text": "0.134 ± 0.0020", "p": 0.31},
        {"method": "3D alignment", "faces": 99, "mean": math.inf, "± 95 %": math.nan, "text": None, "p": -1.5e-7},
        {"method": HOSTILE, "faces": 1000, "mean": np.float32(0.2), "text": "0.02 ± 0.1", "p": np.float64(0.05)},
    )
    formats = {"method": "", "faces": "", "mean": ".4f", "± 95 %": ".4f", "text": "", "p": ".2g"}
    return ReportTable("table-7", "Methods on LFPW, 50 % < x_i & more", formats, rows)


def whole(ax: "matplotlib.axes.Axes") -> "matplotlib.figure.Figure":
    """The figure of axes that are in no part of it."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def ced_figure(name: str, rng: np.random.Generator) -> ReportFigure:
    ax = plot_ced({method: rng.gamma(4.0, 0.02, 300) for method in METHODS})
    ax.set_title("cumulative error")
    return ReportFigure(name, f"CED of {name}", whole(ax), "Share of faces whose NMED is at most x.")


def surface_figure() -> ReportFigure:
    pitches, yaws = np.arange(-90.0, 91, 30), np.arange(-90.0, 91, 15)
    mean = 4 + np.abs(yaws)[None] / 6 + np.abs(pitches)[:, None] / 5
    counts = np.ones(mean.shape, int)
    surface = plot_pose_surface(PoseGrid(pitches, yaws, mean, counts, 0 * counts), title="yaw")
    return ReportFigure("figure-20", "Error of yaw by pose", whole(surface))


def map_figure() -> ReportFigure:
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(9, 3))
    ax.pcolormesh(np.arange(12.0).reshape(3, 4))
    ax.text(0.5, 0.5, "low", color="white")
    ax.text(3.5, 2.5, "high", color="black")
    ax.set_title("over colours")
    return ReportFigure("figure-map", "A map of colours, with texts that stay black and white", figure)


def head_shape() -> np.ndarray:
    """(68, 2) a face of the scheme ibug68 within the unit square."""
    turn = np.linspace(np.pi, 0, 17)
    ring = np.linspace(0, 2 * np.pi, 6, endpoint=False) + np.pi
    mouth = np.linspace(0, 2 * np.pi, 12, endpoint=False) + np.pi
    inner = np.linspace(0, 2 * np.pi, 8, endpoint=False) + np.pi
    brow = np.linspace(0, 1, 5)
    return np.concatenate(
        [
            np.stack([0.5 + 0.38 * np.cos(turn), 0.4 + 0.5 * np.sin(turn)], -1),
            np.stack([0.18 + 0.25 * brow, 0.3 - 0.05 * np.sin(np.pi * brow)], -1),
            np.stack([0.57 + 0.25 * brow, 0.3 - 0.05 * np.sin(np.pi * brow)], -1),
            np.stack([np.full(4, 0.5), np.linspace(0.38, 0.56, 4)], -1),
            np.stack([np.linspace(0.42, 0.58, 5), 0.6 + 0.02 * np.sin(np.pi * brow)], -1),
            np.stack([0.31 + 0.07 * np.cos(ring), 0.4 + 0.03 * np.sin(ring)], -1),
            np.stack([0.69 + 0.07 * np.cos(ring), 0.4 + 0.03 * np.sin(ring)], -1),
            np.stack([0.5 + 0.15 * np.cos(mouth), 0.73 + 0.06 * np.sin(mouth)], -1),
            np.stack([0.5 + 0.1 * np.cos(inner), 0.73 + 0.02 * np.sin(inner)], -1),
        ]
    )


def gallery_face(index: int, rng: np.random.Generator) -> GalleryFace:
    yaw, pitch = rng.uniform(-60, 60), rng.uniform(-30, 30)
    truth = SIDE * (0.15 + 0.7 * head_shape()) + rng.normal(0, 2, 2)
    blobs = cv2.GaussianBlur(rng.uniform(0, 255, (SIDE, SIDE)).astype(np.float32), (0, 0), 6)
    pixels = cv2.normalize(blobs, blobs, 40, 220, cv2.NORM_MINMAX).astype(np.uint8)
    jpeg = None if index % 7 == 0 else cv2.imencode(".jpg", pixels)[1].tobytes()
    errors = dict(zip(METHODS, rng.gamma(4.0, 0.02, 3).tolist(), strict=True))
    fits = {method: truth + rng.normal(0, 12 * error, truth.shape) for method, error in errors.items()}
    if index % 9 == 1:
        errors["SDM"], fits["SDM"] = math.inf, np.full_like(truth, np.nan)
    if index % 9 == 2:
        errors["SDM"] = math.nan
        truth[40:] = np.nan
    if index == 4:
        yaw = math.nan
    return GalleryFace(
        ("LFPW", "AFLW")[index % 2],
        HOSTILE if index == 3 else f"image_{index:04d}",
        SIDE,
        jpeg,
        truth,
        fits,
        errors,
        yaw,
        pitch,
    )


@cache
def sample_gallery(faces: int = 60) -> Gallery:
    rng = np.random.default_rng(4)
    lines = {"LFPW": IBUG68.lines, "AFLW": IBUG68.lines}
    return Gallery("Faces and their fits", tuple(gallery_face(i, rng) for i in range(faces)), lines, "Drawn faces.")


def build() -> Report:
    """A report like the real ones."""
    rng = np.random.default_rng(5)
    grids = [(method, dataset) for dataset in ("LFPW", "AFLW") for method in METHODS][:4]
    introduction = (
        "Each method was trained with a number of augmentations and cascade steps, and tested on held-out faces. "
        "The tables show the mean error over faces, in distances between the eyes."
    )
    steps = Section(
        "Augmentations and steps",
        (introduction,),
        tuple(grid_table(f"table-{i}", f"{method} on {dataset}", rng) for i, (method, dataset) in enumerate(grids)),
    )
    methods = Section(
        "Methods compared",
        ("First paragraph.", "Second paragraph, which says <b>nothing</b>."),
        (
            comparison_table(),
            ced_figure("figure-12", rng),
            ced_figure("figure-13", rng),
            surface_figure(),
            map_figure(),
        ),
    )
    return Report(
        "Face landmarks by cascaded regression: experiments",
        {"jaxfit": "1.4.0", "machine": "2 cores", "faces": "AFLW 2359, LFPW 836", "configuration": HOSTILE},
        (steps, methods, Section("Faces", (), (sample_gallery(),)), Section("Nothing to show")),
    )


@pytest.fixture(autouse=True)
def agg() -> Iterator[None]:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    yield
    plt.close("all")


@pytest.fixture(scope="module")
def report() -> Report:
    import matplotlib

    matplotlib.use("Agg")
    return build()


@pytest.fixture(scope="module")
def folder(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the written report."""
    folder = tmp_path_factory.mktemp("report") / "new"
    write_files(report, folder)
    return folder


def parts(report: Report, kind: type[PartKind]) -> list[PartKind]:
    """The report's tables, or its figures, which are closed."""
    return [part for section in report.sections for part in section.parts if isinstance(part, kind)]


def small_report() -> Report:
    """One of each."""
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(2, 1))
    ax.plot([0, 1], label="a line")
    table = ReportTable("numbers", "Numbers", {"n": "", "x": ".1f"}, ({"n": 1, "x": 0.25}, {"n": 2}), "Of no matter.")
    drawn = ReportFigure("drawing", "A drawing", figure, "Small.")
    return Report("Small", {"made": "here"}, (Section("All", ("Few words.",), (table, drawn, sample_gallery(5))),))


def gallery_json(page: str) -> list[dict]:
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)]


def test_every_table_can_be_read_back(report: Report, folder: Path) -> None:
    tables = parts(report, ReportTable)
    assert {path.name for path in (folder / "tables").iterdir()} == {
        f"{table.name}.{end}" for table in tables for end in ("csv", "tex")
    }
    for table in tables:
        with open(folder / "tables" / f"{table.name}.csv", encoding="utf-8", newline="") as file:
            heading, *rows = csv.reader(file)
        assert heading == list(table.columns)
        assert len(rows) == len(table.rows)
        for read, row in zip(rows, table.rows, strict=True):
            for text, value in zip(read, (row.get(name) for name in table.columns), strict=True):
                if value is None or isinstance(value, str):
                    assert text == (value or "")
                else:  # to the last bit
                    kind: Any = type(value)
                    np.testing.assert_array_equal(kind(text), value)


def test_latex() -> None:
    rows = (
        {"a_b & c": "50 % {of} \\x^2~#$", "Δ": -0.1234, "n": 3},
        {"a_b & c": "± 1 °", "Δ": None, "n": math.inf},
    )
    table = ReportTable("t", "Two\nlines", {"a_b & c": "", "Δ": ".2f", "n": ""}, rows)
    assert latex_table(table).splitlines() == [
        "% Two lines",
        r"% Needs \usepackage{booktabs}.",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"a\_b \& c & Δ & n \\",
        r"\midrule",
        r"50 \% \{of\} \textbackslash{}x\textasciicircum{}2\textasciitilde{}\#\$ & $-$0.12 & 3 \\",
        r"$\pm$ 1 $^\circ$ & -- & $\infty$ \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_figures_are_black_on_white_and_closed(report: Report, folder: Path, tmp_path: Path) -> None:
    import matplotlib.pyplot as plt

    small = small_report()
    assert plt.get_fignums()
    write_files(small, tmp_path)
    assert not plt.get_fignums()
    for figure in parts(report, ReportFigure):
        pixels = cv2.imread(str(folder / "figures" / f"{figure.name}.png"))
        assert pixels is not None
        assert (pixels[0] == 255).all()
        assert pixels.min() < 40
        svg = (folder / "figures" / f"{figure.name}.svg").read_text(encoding="utf-8")
        assert svg.startswith("<?xml")
        assert "var(" not in svg


def test_drawings_in_the_page_follow_its_colours_and_share_no_id(report: Report, folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    ids = re.findall(r'\bid="([^"]*)"', page)
    assert len(ids) == len(set(ids)) > 100
    referred = re.findall(r'(?:href="#|url\(#)([^")]*)', page)
    assert set(referred) <= set(ids)
    drawings = re.findall(r'class="drawing".*?</svg>', page, re.DOTALL)
    assert len(drawings) == len(parts(report, ReportFigure))
    for drawing in drawings:
        assert not re.search(r": #(000000|ffffff)\b", drawing)
        assert set(re.findall(r"var\((--grey-..)\)", drawing)) == set(re.findall(r"(--grey-..):", drawing))


def test_greys_lie_between_ink_and_ground() -> None:
    svg = (
        '<?xml?><svg width="1pt" viewBox="0 0 72 36" xmlns="x"><a id="b" style="fill: #333333; stroke: #123456"/></svg>'
    )
    assert inline_svg(svg, "f", 'a "b"') == (
        '<svg viewBox="0 0 72 36" role="img" aria-label="a &quot;b&quot;" style="--grey-33: color-mix(in srgb, '
        'currentColor 80.0%, var(--card)); --width: 96px; fill: currentColor">'
        '<a id="f-b" style="fill: var(--grey-33); stroke: #123456"/></svg>'
    )


def test_the_page_refers_to_nothing_outside(report: Report, folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r"https?://|@import|url\((?!#)", page)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    links = [source for source in sources if not source.startswith(("#", "data:"))]
    assert len(links) == 2 * (len(parts(report, ReportTable)) + len(parts(report, ReportFigure)))
    assert all((folder / link).is_file() for link in links)


def test_the_same_document_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_files(small_report(), tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 2 + 2 + 2  # two pages, the files of a table, and of a figure
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert (tmp_path / "a" / "report.md").read_text(encoding="utf-8") == (
        "# Small\n\n- made: here\n\n## All\n\nFew words.\n\n### Numbers\n\n| n | x |\n| ---: | ---: |\n| 1 | 0.2 |\n"
        "| 2 | - |\n\nOf no matter.\n\n### A drawing\n\n![A drawing](figures/drawing.png)\n\nSmall.\n"
    )


def test_texts_are_escaped(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "<script>document" not in page
    assert "<b>nothing" not in page
    (data,) = gallery_json(page)
    assert data["faces"][3]["name"] == HOSTILE


def test_galleries_hold_faces_to_a_tenth_of_a_pixel(folder: Path) -> None:
    (data,) = gallery_json((folder / "report.html").read_text(encoding="utf-8"))
    gallery = sample_gallery()
    assert [tuple(map(tuple, lines)) for lines in data["lines"]] == [gallery.lines[name] for name in data["datasets"]]
    for stored, face in zip(data["faces"], gallery.faces, strict=True):
        assert data["datasets"][stored["dataset"]] == face.dataset
        for index, method in enumerate(data["methods"]):
            points = np.array(stored["fits"][str(index)], float).reshape(-1, 2) / 10
            np.testing.assert_allclose(points, face.fits[method], rtol=0, atol=0.05 + 1e-9)
            error = stored["errors"][str(index)]
            np.testing.assert_allclose(
                math.nan if error is None else float(error), face.errors[method], rtol=0, atol=1e-7
            )


@pytest.mark.parametrize("name", ["", "../x", "a/b", "a b", ".x", "x.", "a..b", 'a"b', "ü", "x\n"])
def test_names_must_be_file_names(name: str, tmp_path: Path) -> None:
    table = ReportTable(name, "t", {"a": ""}, ())
    with pytest.raises(InputError, match="letters and digits"):
        write_files(Report("d", {}, (Section("s", (), (table,)),)), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_names_must_differ_even_where_case_is_not_told(tmp_path: Path) -> None:
    table = ReportTable("t-0.1", "t", {"a": ""}, ({"a": 1},))
    section = Section("s", (), (table, replace(table, name="T-0.1")))
    with pytest.raises(InputError, match=r"T-0\.1"):
        write_files(Report("d", {}, (section,)), tmp_path)
    write_files(Report("d", {}, (replace(section, parts=(table,)),)), tmp_path)
    assert (tmp_path / "tables" / "t-0.1.csv").read_text(encoding="utf-8") == "a\n1\n"


def test_without_jinja2_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(InputError, match=r'pip install "jaxfit\[experiments\]"'):
        write_files(Report("d"), tmp_path)


# In a browser.


class OpenPage:
    """The report in a browser: one page for all tests, which leave it as they found it, and are fast for that."""

    def __init__(self, page: Any, address: str):
        self._page, self._address = page, address
        self._problems: list[str] = []
        self._requests: list[str] = []
        page.set_default_timeout(20_000)
        page.on("console", lambda message: self._problems.append(message.text))
        page.on("pageerror", lambda error: self._problems.append(str(error)))
        page.on("request", lambda request: self._requests.append(request.url))
        self._loaded = False

    @contextmanager
    def __call__(self, width: int = 1280, fresh: bool = False) -> Iterator[Any]:
        """The page at a width, loaded again if it must be ``fresh`` or a test before it failed; afterwards there must
        have been no error and no request but for the page itself."""
        page = self._page
        page.set_viewport_size({"width": width, "height": 900})
        if fresh or not self._loaded:
            self._problems.clear()
            self._requests.clear()
            page.goto(self._address)
        self._loaded = False
        assert page.title() == "Face landmarks by cascaded regression: experiments"
        yield page
        assert self._problems == []
        assert [url for url in self._requests if not url.startswith("data:")] == [self._address]
        self._loaded = True


@pytest.fixture(scope="module")
def opened(browser: Any, folder: Path) -> Iterator[OpenPage]:
    context = browser.new_context()
    yield OpenPage(context.new_page(), (folder / "report.html").as_uri())
    context.close()


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_and_follows_the_colour_scheme(opened: OpenPage, width: int) -> None:
    with opened(width) as page:
        for scheme in ("dark", "light"):
            page.emulate_media(color_scheme=scheme)
            assert page.evaluate("document.documentElement.scrollWidth") == width
            for element in ("body", ".card"):
                colour = page.evaluate(f"getComputedStyle(document.querySelector('{element}')).backgroundColor")
                red, green, blue = map(int, re.findall(r"\d+", colour))
                assert (max(red, green, blue) < 60) == (scheme == "dark")
                assert (min(red, green, blue) > 220) == (scheme == "light")
        # Contents lie beside the text where there is room; otherwise they are closed until they are asked for.
        contents = page.locator(".contents details")
        assert contents.evaluate("details => details.open") == (width == 1280)
        if width == 390:
            contents.locator("summary").click()
        contents.get_by_role("link", name="Faces", exact=True).click()
        assert page.url.endswith("#section-3")
        assert page.locator("#section-3 h2").evaluate("h => h.getBoundingClientRect().top") < 300
        assert contents.evaluate("details => details.open") == (width == 1280)


SORTED = {
    "mean": ["parametric", "SDM", HOSTILE, "3D alignment"],
    "faces": ["3D alignment", "SDM", "parametric", HOSTILE],
    "± 95 %": ["parametric", "SDM", "3D alignment", HOSTILE],  # two are missing
    "text": [HOSTILE, "SDM", "parametric", "3D alignment"],  # by the numbers that they begin with; one is missing
    "p": ["3D alignment", HOSTILE, "parametric", "SDM"],  # one is missing
    "method": [HOSTILE, "3D alignment", "parametric", "SDM"],
}


def test_headings_sort_tables(opened: OpenPage) -> None:
    original = [row["method"] for row in comparison_table().rows]
    with opened() as page:
        table = page.locator('[id="tables/table-7"] table')

        def order() -> list[str]:
            return table.locator("tbody th").all_text_contents()

        for heading, ascending in SORTED.items():
            known = len(ascending) - {"± 95 %": 2, "text": 1, "p": 1}.get(heading, 0)
            cell = table.get_by_role("columnheader", name=heading, exact=True)
            button = cell.get_by_role("button")
            assert order() == original
            button.click()
            assert order() == ascending
            assert cell.get_attribute("aria-sort") == "ascending"
            button.focus()
            page.keyboard.press("Enter")
            descending = order()
            assert descending[known:] == ascending[known:]
            values = {row["method"]: row.get(heading) for row in comparison_table().rows}
            unequal = [values[method] for method in ascending[:known]]
            if len(set(unequal)) == known:
                assert descending[:known] == ascending[:known][::-1]
            else:  # equal ones stay as they were
                assert descending[:known] == [HOSTILE, "SDM", "parametric", "3D alignment"]
            assert table.locator("[aria-sort]").count() == 1
            assert cell.get_attribute("aria-sort") == "descending"
            button.click()
            assert order() == original
            assert table.locator("[aria-sort]").count() == 0


def test_figures_open_large_and_go_back(report: Report, opened: OpenPage) -> None:
    with opened() as page:
        drawing, dialog = page.locator(".drawing").first, page.locator("dialog")
        small = drawing.locator("svg").bounding_box()
        drawing.focus()
        page.keyboard.press("Enter")
        assert dialog.is_visible()
        assert dialog.locator("h2").text_content() == "CED of figure-12"
        large = dialog.locator(".stage svg").bounding_box()
        assert large["width"] > 1.5 * small["width"]
        dialog.get_by_role("button", name="Zoom").click()
        assert dialog.locator(".stage svg").bounding_box()["width"] > 2 * large["width"]
        page.keyboard.press("Escape")
        assert dialog.is_hidden()
        assert drawing.locator("svg").bounding_box()["width"] == small["width"]
        assert drawing.evaluate("button => button === document.activeElement")
        page.locator(".drawing").nth(2).click()
        assert dialog.locator("h2").text_content() == "Error of yaw by pose"
        dialog.get_by_role("button", name="Close").click()
        assert dialog.is_hidden()
        assert page.locator(".drawing svg").count() == len(parts(report, ReportFigure))


def expected_faces(
    method: str, dataset: str | None = None, sign: int = -1, **ranges: tuple[float | None, float | None]
) -> list[str]:
    """The names of the faces that a gallery should show, in order: an oracle for its filters."""
    gallery = sample_gallery()

    def inside(face: GalleryFace) -> bool:
        values = {"error": face.errors[method], "yaw": face.yaw, "pitch": face.pitch}
        return all(
            (low is None or values[name] >= low) and (high is None or values[name] <= high)
            for name, (low, high) in ranges.items()
        )

    kept = [face for face in gallery.faces if (dataset is None or face.dataset == dataset) and inside(face)]
    # What is unmeasured comes last.
    kept.sort(key=lambda face: (True, 0) if math.isnan(face.errors[method]) else (False, sign * face.errors[method]))
    return [face.face for face in kept]


def test_gallery_filters(opened: OpenPage) -> None:
    with opened() as page:
        gallery = page.locator(".gallery")

        expect = pytest.importorskip("playwright.sync_api").expect

        def shows(faces: list[str]) -> None:
            # Waits: a form that is reset says so before its fields are empty.
            expect(gallery.locator(".face > span:last-child")).to_have_text(faces)
            expect(gallery.locator("output")).to_have_text(f"{len(faces)} of 60 faces")

        shows(expected_faces("SDM"))
        gallery.get_by_label("Order").select_option("best")
        shows(expected_faces("SDM", sign=1))
        gallery.get_by_label("Error, to").fill("0.07")
        shows(expected_faces("SDM", sign=1, error=(None, 0.07)))
        assert 0 < gallery.locator(".face").count() < 60
        gallery.get_by_label("Dataset").select_option("AFLW")
        gallery.get_by_label("Method").select_option("3D alignment")
        gallery.get_by_label("Order").select_option("worst")
        shows(expected_faces("3D alignment", "AFLW", error=(None, 0.07)))
        gallery.get_by_label("Error, to").fill("")
        gallery.get_by_label("Yaw [°], from").fill("-20")
        gallery.get_by_label("Pitch [°], to").fill("10.5")
        shows(expected_faces("3D alignment", "AFLW", yaw=(-20, None), pitch=(None, 10.5)))
        assert 0 < gallery.locator(".face").count() < 20
        gallery.get_by_label("Error, from").fill("7")
        shows([])
        assert gallery.get_by_text("No face is like that.").is_visible()
        gallery.get_by_role("button", name="Show all").click()
        shows(expected_faces("SDM"))
        errors = gallery.locator(".face b").all_text_contents()
        assert errors.count("no fit") == 7
        assert errors[:7] == ["no fit"] * 7
        assert errors.count("unmeasured") == 7
        assert errors[-7:] == ["unmeasured"] * 7


def test_faces_show_truth_and_the_fit_of_the_method_and_enlarge(opened: OpenPage) -> None:
    gallery = sample_gallery()
    by_name = {face.face: face for face in gallery.faces}
    names = expected_faces("parametric")
    with opened(390, fresh=True) as page:
        page.locator(".gallery").get_by_label("Method").select_option("parametric")
        card = page.locator(".face").first
        card.scroll_into_view_if_needed()
        card.locator("svg").wait_for()
        face = by_name[names[0]]
        assert card.locator("img").count() == (face.jpeg is not None)
        assert page.locator(".face").last.locator("svg").count() == 0  # too far away to be drawn
        for name, points in (("truth", face.truth), ("fit", face.fits["parametric"])):
            path = card.locator(f".dots.{name}").get_attribute("d")
            drawn = np.array([pair.split() for pair in re.findall(r"M([^h]*)h", path)], float)
            np.testing.assert_allclose(drawn, points[np.isfinite(points[:, 0])], rtol=0, atol=0.051)
        strokes = [
            card.locator(f".line.{name}").evaluate("p => getComputedStyle(p).stroke") for name in ("truth", "fit")
        ]
        assert strokes == ["rgb(255, 65, 54)", "rgb(23, 224, 242)"]
        card.click()
        dialog = page.locator("dialog")
        assert dialog.locator("h2").text_content() == f"{face.dataset}: {face.face}"
        assert f"{face.errors['parametric']:.4f}" in dialog.locator("[aria-current]").text_content()
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        page.keyboard.press("ArrowRight")
        assert dialog.locator("h2").text_content().endswith(names[1])
        dialog.get_by_role("button", name="Previous face").click()
        dialog.get_by_role("button", name="Previous face").click()
        assert dialog.locator("h2").text_content().endswith(names[-1])
        page.keyboard.press("Escape")
        assert dialog.is_hidden()
