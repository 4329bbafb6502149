"""What reaches the terminal."""

import ast
from pathlib import Path
from types import SimpleNamespace

import pytest

from jaxfit.cli import progress
from jaxfit.cli.progress import Bars, say


def test_no_control_characters_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("written: \x1b[2Jfits\x9b\u202e\udce9\nand more")
    assert capsys.readouterr().out == "written: \\x1b[2Jfits\\u009b\\u202e\\xe9\nand more\n"


def test_commands_print_nothing_in_another_way() -> None:
    for path in Path(progress.__file__).parent.glob("*.py"):
        called = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        count = sum(isinstance(name, ast.Name) and name.id == "print" for name in called)
        assert count == (path.name == "progress.py"), path


def test_logs_have_lines_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    clock = [0.0]
    monkeypatch.setattr("jaxfit.cli.progress.time", SimpleNamespace(monotonic=lambda: clock[0]))
    with Bars() as bars:
        for second in range(4001):
            clock[0] = float(second)
            bars("fitting pictures", 800 + 4 * second, 20_000)
    first, *counts = capsys.readouterr().err.splitlines()
    assert first == "fitting pictures …"
    assert counts[:2] == [
        "fitting pictures: 840 of 20,000, 4.0/s",
        "fitting pictures: 880 of 20,000, 4.0/s",
    ]
    assert 60 < len(counts) < 100  # every ten seconds at first, then less often
    with Bars(announced=False) as quiet:
        for second in range(4001, 4040):
            clock[0] = float(second)
            quiet(f"stage {second // 3}", 0, 3)
    assert len(capsys.readouterr().err.splitlines()) == 3
