"""What reaches the terminal."""

import ast
from pathlib import Path

import pytest

from jaxfit.cli import progress
from jaxfit.cli.progress import say


def test_no_control_characters_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("written: \x1b[2Jfits\x9b\u202e\udce9\nand more")
    assert capsys.readouterr().out == "written: \\x1b[2Jfits\\u009b\\u202e\\xe9\nand more\n"


def test_commands_print_nothing_in_another_way() -> None:
    for path in Path(progress.__file__).parent.glob("*.py"):
        called = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        count = sum(isinstance(name, ast.Name) and name.id == "print" for name in called)
        assert count == (path.name == "progress.py"), path
