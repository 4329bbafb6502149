"""What a report says, and which of it is of the thesis."""

import re
from collections.abc import Iterator

import numpy as np

from jaxfit.experiments.report_parts import Report, ReportFigure, ReportTable

OF_THESIS = re.compile(r"thesis|claim|appendix|appendices|\bEq\.|\b(?:Figure|Tables?) \d|\(\d\.\d\)", re.IGNORECASE)


def words_of(report: Report) -> Iterator[str]:
    """Everything that a report says, inside its figures too."""
    from matplotlib.text import Text

    yield report.title
    for pair in report.about.items():
        yield from pair
    for section in report.sections:
        yield from (section.title, *section.text)
        for part in section.parts:
            yield from (part.title, part.note)
            if isinstance(part, ReportTable):
                yield from (*part.columns, *(str(value) for row in part.rows for value in row.values()))
            elif isinstance(part, ReportFigure):
                yield from (text.get_text() for text in part.figure.findobj(Text))


def check_is_the_same_without_the_thesis(report: Report, plain: Report) -> None:
    """The first report, which speaks of the thesis, has the parts and the numbers of the second, which does not."""
    assert any(OF_THESIS.search(text) for text in words_of(report))
    assert [text for text in words_of(plain) if OF_THESIS.search(text)] == []
    sections = [section for section in report.sections if section.name != "claims"]
    parts = [part for section in sections for part in section.parts]
    own = [part for section in plain.sections for part in section.parts]
    assert [part.name for part in parts] == [part.name for part in own]
    for beside, alone in zip(parts, own, strict=True):
        if isinstance(alone, ReportTable):
            assert isinstance(beside, ReportTable)
            assert [heading for heading in beside.columns if heading in alone.columns] == list(alone.columns)
            for more, row in zip(beside.rows, alone.rows, strict=True):
                np.testing.assert_equal({heading: more[heading] for heading in row}, dict(row))
