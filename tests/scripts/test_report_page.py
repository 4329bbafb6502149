"""The page of a measuring script: figures between the marks of a page, or a page of its own in a folder of results."""

import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import pytest
from script_runner import load

import jaxfit
from jaxfit.errors import InputError
from jaxfit.labels.records import Dataset
from jaxfit.schemes.known import IBUG68

BEGIN, END = "<!-- figures -->\n", "<!-- end of figures -->\n"
TABLE = "| a | b |\n| ---: | --- |\n| 0.50 | two |"


@pytest.fixture
def report() -> Any:
    return load("report")


@pytest.fixture
def measure(report: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run a script that measures next to nothing, with these arguments."""

    def measured(*arguments: str, out: str = "", code: int | None = None) -> int:
        def run(_: Namespace, found: Any) -> int | None:
            found.title = "Next to nothing"
            found.table([{"a": 0.5, "b": "two"}], {"a": ".2f", "b": ""}, above="One row:")
            found.add("And words.")
            return code

        monkeypatch.setattr(sys, "argv", ["somewhere/scripts/nothing.py", *arguments])
        return report.measure(run, report.script_parser("Nothing.", out).parse_args())

    return measured


def test_parts_are_printed_with_the_machine(
    measure: Callable[..., int], report: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure() == 0
    assert capsys.readouterr().out == f"One row:\n\n{TABLE}\n\nAnd words.\n\n{report.made_with()}\n"
    assert report.made_with().startswith(f"jaxfit {jaxfit.__version__}, jax {jax.__version__}, numpy ")
    assert measure(code=1) == 1


def test_figures_are_put_between_the_marks(measure: Callable[..., int], report: Any, tmp_path: Path) -> None:
    page = tmp_path / "a page.md"
    figures = f"```\npython scripts/nothing.py --report '{page}'\n```\n\n{report.made_with()}\n\n"
    figures += f"One row:\n\n{TABLE}\n\nAnd words.\n"
    assert measure("--report", str(page)) == 0
    assert page.read_text() == f"# Next to nothing\n\n{BEGIN}{figures}{END}"
    page.write_text(f"# My title\n\nBefore.\n\n{BEGIN}old\n{END}\nAfter.\n")
    assert measure("--report", str(page)) == 0
    assert page.read_text() == f"# My title\n\nBefore.\n\n{BEGIN}{figures}{END}\nAfter.\n"
    page.write_text("Words without marks.\n")
    assert measure("--report", str(page)) == 0
    assert page.read_text() == f"Words without marks.\n{BEGIN}{figures}{END}"
    assert [path.name for path in tmp_path.iterdir()] == ["a page.md"]


def test_each_section_is_put_between_marks_of_its_own(report: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    for _ in range(2):
        for name in ("one", "two"):  # run by run
            found = report.Report()
            found.begin(name)
            found.add(f"Of {name}.")
            found.write(page, whole=False)
    text = page.read_text()
    parts = [part.partition(END)[0] for part in text.split("<!-- figures: ")[1:]]
    assert [part.splitlines()[0] for part in parts] == ["one -->", "two -->"]
    assert [part.splitlines()[-1] for part in parts] == ["Of one.", "Of two."]
    page.write_text(text.replace("Of one.", "Of old.").replace(END, f"{END}Words.\n"))
    found.write(page, whole=False)
    assert page.read_text() == text.replace("Of one.", "Of old.").replace(END, f"{END}Words.\n")


def test_a_folder_of_results_has_a_page_of_its_own(measure: Callable[..., int], tmp_path: Path) -> None:
    out = tmp_path / "results"
    for _ in range(2):
        assert measure("--out", str(out), out="results") == 0
        text = (out / "nothing.md").read_text()
        assert text.startswith(f"# Next to nothing\n\n```\npython scripts/nothing.py --out {out}\n```\n\njaxfit ")
        assert text.endswith(f"One row:\n\n{TABLE}\n\nAnd words.\n")


def test_pages_that_cannot_be_written_are_refused_before_the_work(
    measure: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert measure("--report", str(tmp_path / "nowhere" / "page.md")) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "--report: expected a file in a folder that exists" in printed.err


def test_nothing_is_written_if_the_work_fails(report: Any, tmp_path: Path) -> None:
    def run(_: Namespace, found: Any) -> None:
        raise InputError("it cannot be done")

    assert report.measure(run, Namespace(report=str(tmp_path / "page.md"))) == 2
    assert not list(tmp_path.iterdir())


def test_datasets_are_called_after_their_folders(report: Any) -> None:
    def names(*specs: str) -> list[str]:
        return report.dataset_names([Dataset(spec, IBUG68, ()) for spec in specs])

    assert names("pts:a/lfpw68", "aflw+0.5:b/aflw/") == ["lfpw68", "aflw"]
    assert names("pts:a/faces", "pts0:b/faces") == ["pts:a/faces", "pts0:b/faces"]
