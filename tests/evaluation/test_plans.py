"""Plans of evaluations: where fits start, in how many passes, and requests that are refused before the work."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from csv_files import write_boxes

import jaxfit
from jaxfit.evaluation import EvaluationRun, plan_evaluation
from jaxfit.fitting import Fitting
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.models.model import Model
from jaxfit.schemes import AFLW21


@pytest.fixture(scope="module")
def model() -> Model:
    return jaxfit.load("face21")


@pytest.fixture
def specs(heads: tuple[FaceRecord, ...], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A dataset of three drawn heads."""
    monkeypatch.setitem(FORMATS, "drawn", lambda path: Dataset("drawn", AFLW21, heads[:3]))
    return ["drawn:x"]


@pytest.mark.parametrize(
    ("run", "box_kind", "passes"),
    [
        (EvaluationRun(), "square", 1),
        (EvaluationRun(Fitting("haar")), "haar", 2),
        (EvaluationRun(Fitting("yunet", jaxfit.Search(smallest=30.0))), "yunet", 1),
        (EvaluationRun(Fitting("haar", passes=3)), "haar", 3),
        (EvaluationRun(boxes="boxes.csv"), "square", 1),
        (EvaluationRun(boxes="boxes.csv", box_kind="whole"), "whole", 2),
    ],
)
def test_fits_start_in_boxes_of_the_kind_that_was_asked_for(
    run: EvaluationRun,
    box_kind: str,
    passes: int,
    model: Model,
    specs: Sequence[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes.csv", {"nowhere.png": (1, 2, 30, 40)})
    plan = plan_evaluation(model, specs, run)
    (planned,) = plan.datasets
    assert (planned.box_kind, plan.pipeline.passes, plan.pipeline.detector) == (box_kind, passes, None)
    assert plan.unused == (() if run.boxes is None else ("nowhere.png",))


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (EvaluationRun(Fitting(search=jaxfit.Search(score=0.5))), "expected a --detector with .*; got none"),
        (EvaluationRun(Fitting("haar"), boxes="boxes.csv"), "boxes or a detector that finds them; got both"),
        (EvaluationRun(Fitting("nose")), "expected a detector among"),
        (EvaluationRun(box_kind="whole"), "give that file too"),
        (EvaluationRun(normaliser="nose"), "nose"),
        (EvaluationRun(refine=True), "only models of the method alignment3d"),
        (EvaluationRun(scheme="ibug68"), "cannot convert"),
    ],
)
def test_what_cannot_be_is_refused_before_the_work(
    run: EvaluationRun,
    words: str,
    model: Model,
    specs: Sequence[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_boxes(tmp_path / "boxes.csv", {"a.png": (1, 2, 30, 40)})
    with pytest.raises(jaxfit.InputError, match=words):
        plan_evaluation(model, specs, run)
