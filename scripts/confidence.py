"""Measure on people held out whether what models say of how likely their fits are good (fits.confidence) is true.

A fourth of the people is kept aside; a model is trained on the others as MODEL was, and taught by models trained on
parts of those: FOLDS + 1 models in all.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import jaxfit
from jaxfit.cli.arguments import add_head, seed
from jaxfit.cli.labelled_faces import add_faces, read_faces
from jaxfit.cli.main import exit_code
from jaxfit.cli.progress import Bars
from jaxfit.data.images import GreyPictures
from jaxfit.data.outputs import atomic_write
from jaxfit.data.records import FaceRecord
from jaxfit.evaluation.calibration import auroc, reliability
from jaxfit.evaluation.curves import LIMIT
from jaxfit.evaluation.folds import split_by_subject
from jaxfit.evaluation.plots import new_figure, plot_reliability
from jaxfit.evaluation.tables import markdown_table
from jaxfit.exceptions import InputError
from jaxfit.models.model import Model
from jaxfit.training import train
from jaxfit.trusting import DETECTED, NO_FACES, Trials, learn_confidence, training_of, try_fits

_PARTS = 4  # one of which is held out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", metavar="MODEL", help="a bundled model's name or a model file")
    add_faces(parser)
    add_head(parser)
    parser.add_argument("--folds", type=int, default=3, help="models that are trained to learn from (default: 3)")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every Nth person alone, for a trial")
    parser.add_argument("--augmentations", type=int, help="starts a face of all trainings, if not as MODEL had")
    parser.add_argument(
        "--report", metavar="FILE.md", help="write the figures here, and a plot beside; needs matplotlib"
    )
    return exit_code(run, parser.parse_args())


def run(arguments: argparse.Namespace) -> int:
    if arguments.every < 1:
        raise InputError(f"expected --every of 1 or more; got {arguments.every}")
    model = jaxfit.load(arguments.model)
    if arguments.augmentations is not None:
        model = replace(model, training=model.training | {"augmentations": arguments.augmentations})
    found = read_faces(arguments)
    if found.scheme != model.scheme:
        raise InputError(f"expected labels {model.scheme.name}, as the model's; got {found.scheme.name}")
    faces = [face for face in found.faces if face.complete]
    kept = set(sorted({face.subject for face in faces})[:: arguments.every])
    faces = [face for face in faces if face.subject in kept]
    pictures = GreyPictures()
    with Bars() as bars:
        trials = _held_out(model, faces, arguments, pictures, bars)
    text = _text(arguments, faces, trials)
    print(text)
    if arguments.report:
        _write(Path(arguments.report), text, trials)
    return 0


def _held_out(
    model: Model, faces: Sequence[FaceRecord], arguments: argparse.Namespace, pictures: GreyPictures, bars: Bars
) -> Trials:
    """The fits, of people that it does not know, of a model like this one, and its confidence in them."""
    parts = split_by_subject([face.subject for face in faces], _PARTS, arguments.seed)
    known = [face for face, part in zip(faces, parts, strict=True) if part > 0]
    others = [face for face, part in zip(faces, parts, strict=True) if part == 0]
    method, options = training_of(model)
    trained = train(known, model.scheme, method=method, options=options, progress=bars, read=pictures).model
    learn = {"folds": arguments.folds, "seed": arguments.seed, "read": pictures, "progress": bars}
    return try_fits(
        learn_confidence(trained, known, **learn), others, seed=arguments.seed, read=pictures, progress=bars
    )


def _text(arguments: argparse.Namespace, faces: Sequence[FaceRecord], trials: Trials) -> str:
    """The report: Markdown."""
    told, good, detected = trials.confidence, trials.good, trials.starts == DETECTED
    nothing = np.isin(trials.starts, NO_FACES) & ~good
    seen = detected | nothing
    known = np.isfinite(told)
    rows = [
        {
            "fits": name,
            "number": int((of & known).sum()),
            "good": float(good[of & known].mean()),
            "AUROC": auroc(told[of & known], what[of & known]),
            "ECE": error and reliability(told[of & known], good[of & known]).error,
        }
        for name, of, what, error in (
            ("faces, or none", seen, detected, None),
            ("good or bad, of faces, in one pass", detected & (trials.passes == 1), good, True),
            ("good or bad, of faces, in two passes", detected & (trials.passes == 2), good, True),
            ("good or bad, all", np.ones_like(good), good, True),
        )
    ]
    kinds = [
        {
            "start": start,
            "number": int((trials.starts == start).sum()),
            "good": float(good[trials.starts == start].mean()),
            "mean confidence": float(np.nanmean(told[trials.starts == start])),
            "ok": float((told[trials.starts == start] >= 0.5).mean()),
        }
        for start in dict.fromkeys(trials.starts.tolist())
    ]
    ok = detected & (told >= 0.5)
    options = "".join(
        f" --{name.replace('_', '-')} {value}"
        for name, value in vars(arguments).items()
        if name in ("lift_yaw", "folds", "seed", "every", "augmentations") and value and (name, value) != ("every", 1)
    )
    data = " ".join(
        f"--{name} "
        + " ".join(f"{format_}:{Path(path).name}" for format_, _, path in (spec.partition(":") for spec in specs))
        for name in ("data", "lift", "without")
        if (specs := getattr(arguments, name))
    ) + (" --fill" if arguments.fill else "")
    number, good_ok = len(faces), float(good[ok].mean())
    columns = {"fits": "", "number": "d", "good": ".3f", "AUROC": ".3f", "ECE": ".3f"}
    of_starts = {"start": "", "number": "d", "good": ".3f", "mean confidence": ".3f", "ok": ".3f"}
    return f"""# Confidence

`fits.confidence` is the probability that a fit is good: that its NMED over the outer eye corners is below {LIMIT}.
A network of one hidden layer tells it from the descriptors that the last step looks at, the sizes of the steps, the
move from the start, and the shape found. `fits.ok` are the fits with a confidence of 0.5 or more.

These are the figures of a model trained as `{Path(arguments.model).stem}` was{_augmented(arguments)}, on three
fourths of the people of {number} faces, and tested on the others: fits from boxes as a detector draws them (moved by 6
to 15 % of their side, scaled by 8 to 20 %; standard deviations), from boxes off by up to half a face and a factor of 2,
in other parts of the pictures (overlap below 0.15), in small parts of the face, in pictures turned upside down, and on
patterns. Half of them are mirrored; each is fitted in one pass of the cascade, and again in two. The network learned
from fits by {arguments.folds} models, each trained on other people than it fitted.

```
python scripts/confidence.py {Path(arguments.model).name} {data}{options} --report docs/confidence.md
```

{markdown_table(rows, columns)}

AUROC is how often one of two gets the higher confidence, as it should; ECE the expected calibration error in 15 bins,
the mean difference of what was told and what happened. The first row is of faces in detectors' boxes, well fitted or
not, against all that is no face.

{markdown_table(kinds, of_starts)}

Of faces in detectors' boxes, {good_ok:.1%} of those that are `ok` are good, and {float(ok[detected & good].mean()):.1%}
of the good ones are `ok`.

![Confidence beside how many fits are good](confidence.png)
"""


def _augmented(arguments: argparse.Namespace) -> str:
    few = arguments.augmentations
    return "" if few is None else f", but with {few} starts a face in training"


def _write(path: Path, text: str, trials: Trials) -> None:
    detected = trials.starts == DETECTED
    known = np.isfinite(trials.confidence)
    figure = new_figure(5, 5)
    curves = {
        name: reliability(trials.confidence[of & known], trials.good[of & known])
        for name, of in (("faces", detected), ("all", np.ones_like(detected)))
    }
    ax = plot_reliability(curves, figure.subplots())
    ax.set(xlabel="confidence", ylabel="share of good fits")
    with atomic_write(path.with_suffix(".png")) as file:
        figure.savefig(file, format="png", dpi=100)
    with atomic_write(path, "w") as file:
        file.write(text.replace("confidence.png", path.with_suffix(".png").name))


if __name__ == "__main__":
    sys.exit(main())
