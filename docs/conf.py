"""The documentation site (`make docs`): these pages by Sphinx, its Markdown MyST and its theme Furo. The pages of the
reference are made here, from the code, before Sphinx reads them."""

import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import jaxfit

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
from build_reference import REFERENCE, write_reference

write_reference(REFERENCE)

project = "jaxfit"
release = jaxfit.__version__
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links to headings are GitHub's
html_theme = "furo"
html_title = f"jaxfit {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_use_index = False
html_show_copyright = False
html_math_renderer = "mathml"


def setup(app: Sphinx) -> None:
    """Equations are drawn by the browser itself, from MathML: the site asks nobody for scripts or fonts."""

    def write(as_block: bool):
        def visit(writer: HTML5Translator, node: nodes.Element) -> None:
            writer.body.append(tex2mathml(node.astext(), as_block=as_block))
            raise nodes.SkipNode

        return visit, None

    app.add_html_math_renderer("mathml", inline_renderers=write(False), block_renderers=write(True))
