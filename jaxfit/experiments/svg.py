"""Figures as SVG and PNG files, and as drawings inside a page that follow the page's colours."""

import io
import re
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from jaxfit.data.outputs import atomic_write
from jaxfit.experiments.report_parts import ReportFigure

if TYPE_CHECKING:
    import matplotlib.figure

_PNG_DPI = 150
_PIXELS_PER_POINT = 96 / 72  # of CSS
_GREY = re.compile(r"(?<=: )#([0-9a-f]{2})\1\1\b")  # in SVG's styles


def write_figure(figure: ReportFigure, folder: Path) -> str:
    """Write ``NAME.svg`` and ``NAME.png``, black on white, and close the figure.

    Returns:
        The drawing as an ``<svg>`` element for a page, by `inline_svg`.

    Raises:
        InputError: the folder does not exist.
    """
    import matplotlib.pyplot as plt

    _keep_colours_on_pictures(figure.figure)
    svg = _svg(figure.figure)
    with atomic_write(folder / f"{figure.name}.svg", "w") as file:
        file.write(svg)
    with atomic_write(folder / f"{figure.name}.png") as file:
        figure.figure.savefig(file, format="png", dpi=_PNG_DPI, bbox_inches="tight")
    plt.close(figure.figure)
    return inline_svg(svg, figure.name, figure.title)


def inline_svg(svg: str, prefix: str, label: str) -> str:
    """matplotlib's SVG file as an element for a page.

    Black becomes the colour of the text, white becomes the page's ``--card``, and greys what lies between the two, so
    that the drawing is right on dark ground too. All ids begin with ``prefix``: those of several drawings must differ.

    Args:
        svg: the file.
        prefix: letters, digits, ``.``, ``_`` and ``-``.
        label: what the drawing shows, for people who cannot see it.
    """
    root, body = svg[svg.index("<svg") :].split(">", 1)
    box = re.search(r'viewBox="([^"]*)"', root)
    assert box is not None  # matplotlib writes one
    # Comments repeat the texts; the style sheet would hold for the whole page, which has one of its own.
    body = re.sub(r"<!--.*?-->\s*|<style.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{prefix}-", body)
    levels = sorted(set(_GREY.findall(body)))
    mixes = "".join(
        f"--grey-{level}: color-mix(in srgb, currentColor {1 - int(level, 16) / 255:.1%}, var(--card)); "
        for level in levels
    )
    body = _GREY.sub(r"var(--grey-\1)", body)
    width = float(box[1].split()[2]) * _PIXELS_PER_POINT
    # What matplotlib draws in black has no fill of its own.
    style = f"{mixes}--width: {width:.0f}px; fill: currentColor"
    return f'<svg viewBox="{box[1]}" role="img" aria-label="{escape(label)}" style="{style}">{body}'


def _svg(figure: "matplotlib.figure.Figure") -> str:
    import matplotlib

    file = io.StringIO()
    # The same figure gives the same file: ids that do not vary, and no date.
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({"svg.hashsalt": "jaxfit", "svg.fonttype": "path"}):
        figure.savefig(file, format="svg", bbox_inches="tight", metadata=metadata)
    return file.getvalue()


def _keep_colours_on_pictures(figure: "matplotlib.figure.Figure") -> None:
    """Tint black, white and grey texts and lines over pictures and colour maps, invisibly.

    They were chosen for what lies below them, not for the page; tinted, `inline_svg` does not take them for greys.
    """
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D
    from matplotlib.text import Text

    for axes in figure.axes:
        if axes.images or any(isinstance(collection, QuadMesh) for collection in axes.collections):
            drawn: list[Text | Line2D] = [*axes.texts, *axes.lines]
            for artist in drawn:
                red, green, blue, alpha = to_rgba(artist.get_color())
                if red == green == blue:
                    artist.set_color((red, green, blue + (1 if blue < 0.5 else -1) / 255, alpha))
