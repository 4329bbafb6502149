"""``jaxfit compare``: models and other programs' fits, measured alike on the same faces."""

import argparse
from contextlib import ExitStack
from pathlib import Path

from jaxfit.cli.arguments import (
    add_boxes,
    add_datasets,
    add_detector,
    add_normaliser,
    add_starts,
    given_fitting,
    seed,
    untrained_starts,
    unused_rows,
)
from jaxfit.cli.progress import Bars, report_problems, say, warn
from jaxfit.data.inputs import require_no_inputs
from jaxfit.data.locks import held
from jaxfit.data.names import plain, table_path, table_word
from jaxfit.data.outputs import MANIFEST, replace_results, require_own_folder, write_csv
from jaxfit.errors import InputError
from jaxfit.evaluation.compare import Comparison, plan_comparison, read_contestants
from jaxfit.evaluation.datasets import EvaluationRun
from jaxfit.evaluation.protocols import PROTOCOLS, protocol_notes
from jaxfit.evaluation.tables import text_table
from jaxfit.experiments.comparison import build_comparison, comparison_tables
from jaxfit.experiments.page import require_page_makers, write_files
from jaxfit.models.model import Model
from jaxfit.schemes.normalisers import NORMALISERS

_COMMAND = "jaxfit compare"
_FACES = "faces.csv"
_PRINTED = ("errors", "tests", "poses", "pose-tests")


def add_command(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "compare",
        help="compare models, and other programs' fits, on labelled faces",
        description="Compare models, exported models and files of fits on the same labelled faces: errors with "
        "bootstrap intervals by subject, paired tests with Holm's correction, effect sizes, errors of pose, curves "
        "and the worst faces, as a page and tables. Fits in files are matched with the labels by their boxes. A "
        "face that a contestant has no fit of is its failure. docs/guides/evaluate-and-compare.md explains how to get "
        "the fits of other programs.",
    )
    command.add_argument(
        "contestants",
        nargs="+",
        metavar="[NAME=]WHAT",
        help="a bundled model's name, a file of a model or of an exported one, or a file of fits: a table such as "
        "landmarks.csv or heads.csv, JSON lines, COCO's keypoints (.json), or a folder of .pts (pts0:DIR if they count "
        "pixels from 0)",
    )
    add_datasets(command)
    add_boxes(command, "models start from the true landmarks' bounding square, moved by 6 %% and scaled by 8 %%")
    add_detector(command, "models start from the boxes in which this detector finds the faces")
    command.add_argument("--seed", type=seed, default=0, help="seed of the random starts (default: 0)")
    add_normaliser(command)
    command.add_argument(
        "--protocol",
        choices=PROTOCOLS,
        help="measure as publications do, and say what is different: "
        + "; ".join(f"{name}, relative to {NORMALISERS[each.normaliser].title}" for name, each in PROTOCOLS.items()),
    )
    add_starts(command, "starts a face of models; several, for models trained for it, find turned faces")
    command.add_argument("--no-pictures", action="store_true", help="show landmarks without the pictures")
    command.add_argument("--out", required=True, metavar="DIR", help="where report.html, tables and figures go")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare, print the tables, write the page and ``faces.csv``."""
    with ExitStack() as until_the_end:
        return _compare(options, until_the_end)


def _compare(options: argparse.Namespace, until_the_end: ExitStack) -> int:
    """What `run` does, in a folder of results that is held from where all requests are known to be right."""
    require_page_makers()
    if options.protocol and options.normaliser:
        raise InputError("expected --protocol, which says what errors are relative to, or --normaliser; got both")
    contestants = read_contestants(options.contestants)
    fitting = given_fitting(options)
    normaliser = PROTOCOLS[options.protocol].normaliser if options.protocol else options.normaliser
    asked = EvaluationRun(fitting, options.boxes, options.box_kind, options.seed, options.scheme, normaliser)
    plan = plan_comparison(contestants, options.data, asked)
    notes = [*plan.notes]
    if options.protocol:
        notes += protocol_notes(options.protocol, plan.datasets)
    for note in notes:
        say(note)
    require_own_folder(options.out, _COMMAND)
    folder = Path(options.out)
    until_the_end.enter_context(held(folder, _COMMAND))
    given = [
        *(each.source for each in contestants),
        *([options.boxes] if options.boxes else []),
        *(face.image for dataset in plan.datasets for face in dataset.faces),
    ]
    require_no_inputs([folder / name for name in ("report.html", _FACES, MANIFEST)], given)
    for each in contestants:
        if isinstance(each.what, Model):
            warn(untrained_starts(each.name, each.what.starts, fitting.starts))
    if plan.starts is not None and plan.starts.unused:
        warn([f"{options.boxes}: {unused_rows(plan.starts.unused)}"])
    with Bars() as bars:
        found = plan.compare(bars)
    extra = {each.name: sum(of.entries[place].extra for of in found) for place, each in enumerate(contestants)}
    notes += [f"{name}: {count} fits in these pictures are no labelled face" for name, count in extra.items() if count]
    written = write_files(build_comparison(found, notes, pictures=not options.no_pictures), folder)
    write_csv(folder / _FACES, _columns(found), _rows(found))
    settings = {
        "contestants": options.contestants,
        "data": options.data,
        "boxes": options.boxes,
        **fitting.settings(),
        "seed": options.seed,
        "scheme": options.scheme,
        "normaliser": normaliser,
    }
    if replaced := replace_results(folder, _COMMAND, [*written, _FACES], settings):
        say(replaced)
    report_problems([problem for dataset in plan.datasets for problem in dataset.problems])
    for table in comparison_tables(found):
        if table.name in _PRINTED:
            say(f"\n{table.title}. {table.note}\n{text_table(table.rows, table.columns)}")
    say(f"written: {folder / 'report.html'}, {folder / _FACES}, {folder / 'tables'}, {folder / 'figures'}")
    return 0


def _columns(found: list[Comparison]) -> list[str]:
    names = [entry.contestant.name for entry in found[0].entries]
    return ["dataset", "face", "subject", "image", *(f"nmed {name}" for name in names)]


def _rows(found: list[Comparison]) -> list[list[object]]:
    rows: list[list[object]] = []
    for of in found:
        errors = [entry.errors for entry in of.entries]
        for number, face in enumerate(of.dataset.faces):
            names = [plain(of.dataset.spec), table_word(face.face), table_word(face.subject), table_path(face.image)]
            rows.append([*names, *("" if each is None else f"{each[number]:.6f}" for each in errors)])
    return rows
