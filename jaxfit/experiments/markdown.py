"""A report as Markdown, for repositories: its texts, tables, and the figures that lie beside it."""

from jaxfit.evaluation.tables import markdown_table
from jaxfit.experiments.report_parts import Report, ReportFigure, ReportTable


def markdown_text(report: Report) -> str:
    """The report as Markdown; figures are those in ``figures/``, galleries are only in the page."""
    parts = [f"# {report.title}", "\n".join(f"- {term}: {fact}" for term, fact in report.about.items())]
    for section in report.sections:
        parts += [f"## {section.title}", *section.text]
        for part in section.parts:
            if isinstance(part, ReportTable):
                parts += [f"### {part.title}", markdown_table(part.rows, part.columns), part.note]
            elif isinstance(part, ReportFigure):
                parts += [f"### {part.title}", f"![{part.title}](figures/{part.name}.png)", part.note]
    return "\n\n".join(part for part in parts if part) + "\n"
