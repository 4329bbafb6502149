"""Run the notebooks and write them as pages with their pictures: ``docs/notebooks``.

The notebooks themselves are stored without outputs. Run this after a change of one: a test compares pages with
notebooks.
"""

import argparse
import base64
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import nbclient
import nbformat

import jaxfit
from jaxfit.data import write_image

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "notebooks"
WIDTH = 900  # of the pictures, in pixels, at most
LINES = 30  # of printed text, at most


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="notebooks without their suffix (default: all)")
    names = parser.parse_args().names
    PAGES.mkdir(exist_ok=True)
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])  # for the kernel
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        if not names or path.stem in names:
            notebook = nbformat.read(path, as_version=4)
            with tempfile.TemporaryDirectory() as work:
                nbclient.execute(notebook, cwd=work, timeout=900, kernel_name="python3")
            for old in PAGES.glob(f"{path.stem}-*.jpg"):
                old.unlink()
            (PAGES / f"{path.stem}.md").write_text(page(path.stem, notebook.cells), encoding="utf-8")
            print(PAGES / f"{path.stem}.md")
    return 0


def page(name: str, cells: list[Any]) -> str:
    """A notebook that has run, as Markdown; its pictures become files beside it."""
    about = (
        f"[The notebook](../../notebooks/{name}.ipynb) with what it shows, as `scripts/render_notebooks.py` wrote it."
    )
    title, *parts = [part for cell in cells for part in parts_of(name, cell)]
    heading, _, rest = title.partition("\n")
    return "\n\n".join([heading, about, rest.strip(), *parts]) + "\n"


def parts_of(name: str, cell: Any) -> list[str]:
    """The text or code of a cell, and what it printed and drew."""
    if cell.cell_type == "markdown":
        return [cell.source]
    parts = [f"```python\n{cell.source}\n```"]
    printed = "".join(
        output.text for output in cell.outputs if output.output_type == "stream" and output.name == "stdout"
    )
    if printed.strip():
        lines = re.sub(r"/tmp/\w+", "…", printed).rstrip().splitlines()
        parts.append("\n".join(["```text", *lines[:LINES], *["…"] * (len(lines) > LINES), "```"]))
    for output in cell.outputs:
        if "image/png" in output.get("data", {}):
            parts.append(f"![What the code draws]({write_picture(name, output.data['image/png'])})")
    return parts


def write_picture(name: str, encoded: str) -> str:
    """Write a picture that is not wider than ``WIDTH``; returns its file's name."""
    picture = jaxfit.read_image(base64.b64decode(encoded))
    height, width = picture.shape[:2]
    if width > WIDTH:
        picture = cv2.resize(picture, (WIDTH, WIDTH * height // width), interpolation=cv2.INTER_AREA)
    file = f"{name}-{len(list(PAGES.glob(f'{name}-*.jpg'))) + 1}.jpg"
    write_image(PAGES / file, picture)
    return file


if __name__ == "__main__":
    sys.exit(main())
