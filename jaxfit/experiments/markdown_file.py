"""A report as Markdown, for repositories: its texts, tables, and the figures that lie beside it."""

from jaxfit.evaluation.tables import markdown_table
from jaxfit.experiments.document import Document, Figure, Table


def markdown_text(document: Document) -> str:
    """The report as Markdown; figures are those in ``figures/``, galleries are left to the page."""
    parts = [f"# {document.title}", "\n".join(f"- {what}: {told}" for what, told in document.about.items())]
    for section in document.sections:
        parts += [f"## {section.title}", *section.text]
        for part in section.parts:
            if isinstance(part, Table):
                parts += [f"### {part.title}", markdown_table(part.rows, part.columns), part.note]
            elif isinstance(part, Figure):
                parts += [f"### {part.title}", f"![{part.title}](figures/{part.name}.png)", part.note]
    return "\n\n".join(part for part in parts if part) + "\n"
