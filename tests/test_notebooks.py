"""Every notebook runs from top to bottom, and is stored without what running leaves behind."""

import ast
import importlib
import json
import os
import re
from pathlib import Path
from types import ModuleType

import pytest

import jaxfit

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@each_notebook
def test_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipykernel")
    pytest.importorskip("matplotlib")
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    # The kernel is another process: it gets the jaxfit that is tested here, and no settings of whoever runs the tests.
    monkeypatch.setenv("PYTHONPATH", str(Path(jaxfit.__file__).parents[1]), prepend=os.pathsep)
    monkeypatch.delenv("MPLBACKEND", raising=False)
    for folder in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(folder, str(tmp_path / folder.lower()))
    notebook = nbformat.read(path, as_version=4)
    work = tmp_path / "work"
    work.mkdir()
    nbclient.execute(notebook, cwd=str(work), timeout=300, kernel_name="python3")
    shown = [output for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    assert any("image/png" in output["data"] for output in shown), "no figure was drawn"


@each_notebook
def test_is_stored_clean(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    assert set(notebook["metadata"]) == {"kernelspec"}
    for cell in notebook["cells"]:
        assert cell["id"]
        assert not cell["metadata"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


@each_notebook
def test_its_page_is_up_to_date_and_has_pictures(path: Path) -> None:
    page = Path(__file__).resolve().parents[1] / "docs" / "notebooks" / f"{path.stem}.md"
    text = " ".join(page.read_text(encoding="utf-8").split())
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        for paragraph in "".join(cell["source"]).split("\n\n"):
            assert " ".join(paragraph.split()) in text, f"run python scripts/render_notebooks.py {path.stem}"
    pictures = re.findall(r"\]\(([\w-]+\.jpg)\)", text)
    assert pictures
    assert all((page.parent / picture).exists() for picture in pictures)


def private_names(code: str) -> set[str]:
    """What is used of jaxfit that is public neither at its top level nor in one of its namespaces."""
    tree = ast.parse(code)
    # Only the longest of the dotted names: jaxfit.data.read_image, not jaxfit.data.
    inner = {node.value for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node not in inner}
    used = {name for name in used if re.fullmatch(r"jaxfit(\.\w+)+", name)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "jaxfit":
            used |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.Import):
            used |= {alias.name for alias in node.names if alias.name.startswith("jaxfit.")}
    return {name for name in used if not is_public(name)}


def is_public(name: str) -> bool:
    """Whether ``jaxfit.NAME`` or ``jaxfit.NAMESPACE.NAME``, or what begins with one of them, is public."""
    first, second, *_ = [*name.removeprefix("jaxfit.").split("."), ""]
    if first not in (*jaxfit.__all__, "experiments"):
        return False
    if first not in jaxfit.__all__ or isinstance(getattr(jaxfit, first), ModuleType):
        return second == "" or second in importlib.import_module(f"jaxfit.{first}").__all__
    return True


@each_notebook
def test_uses_public_names(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert "jaxfit" in code
    assert private_names(code) == set()


def test_private_names_are_found() -> None:
    code = "from jaxfit.data import crops, read_image\nimport jaxfit\njaxfit.data.Crops.of(jaxfit.shapes.SPACES)"
    assert private_names(code) == {"jaxfit.data.crops", "jaxfit.shapes.SPACES"}


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS
