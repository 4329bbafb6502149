"""Choosing options by people kept aside: what is absurd is not taken, chance is not followed, and models record it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_heads import OPTIONS

import jaxfit
from jaxfit.errors import InputError
from jaxfit.learning import choose as choosing
from jaxfit.learning.choose import Chosen, choose_options, default_candidates
from jaxfit.schemes.known import AFLW21

CANDIDATES = {"windows": [(0.01, 0.01)], "ridge": [1e6, 0.1]}


@pytest.fixture(scope="module")
def choose(heads):
    """Chooses for drawn heads."""
    return lambda: choose_options(heads, AFLW21, options=OPTIONS, candidates=CANDIDATES, folds=2)


@pytest.fixture(scope="module")
def chosen(choose) -> Chosen:
    return choose()


def test_what_is_better_is_taken_and_what_is_absurd_is_not(chosen) -> None:
    assert chosen.options == OPTIONS.but(ridge=0.1)
    strong, weak, blind = chosen.choices
    assert [choice.value for choice in chosen.choices] == [1e6, 0.1, (0.01, 0.01)]
    assert [choice.taken for choice in chosen.choices] == [False, True, False]
    # Of no use in the first fold: the second was left out.
    assert [choice.faces for choice in chosen.choices] == [16, 32, 16]
    assert weak.error < 0.95 * weak.best
    assert min(strong.error - strong.best, blind.error - blind.best) > 0.005


def test_the_same_seed_chooses_by_the_same_errors(choose, chosen) -> None:
    assert choose() == chosen


def test_models_say_how_their_options_were_chosen(chosen, head_models, tmp_path: Path) -> None:
    model = head_models["alignment3d"]
    jaxfit.save(chosen.recorded(model), tmp_path / "chosen.safetensors")
    written = jaxfit.load(tmp_path / "chosen.safetensors").training
    assert {key: written[key] for key in model.training} == model.training
    assert written["chosen"]["folds"] == 2
    assert [entry["value"] for entry in written["chosen"]["trials"]] == [1e6, 0.1, [0.01, 0.01]]
    assert [entry["error"] for entry in written["chosen"]["trials"]] == [choice.error for choice in chosen.choices]


def pretended(monkeypatch, error_of) -> list[tuple[set[str], set[str]]]:
    """Trainings and fits take no time: ``error_of`` gives a face's error for its number and the options. Who was
    learned from and who was kept aside is returned."""
    people: list[tuple[set[str], set[str]]] = []

    def train(faces, scheme, *, options, **_):
        people.append(({face.subject for face in faces}, set()))
        return SimpleNamespace(model=options)

    def evaluate(options, faces, boxes, **_):
        people[-1][1].update(face.subject for face in faces)
        return SimpleNamespace(errors=np.array([error_of(int(face.face[4:]), options) for face in faces]))

    monkeypatch.setattr(choosing, "train", train)
    monkeypatch.setattr(choosing, "evaluate", evaluate)
    return people


def test_folds_split_no_person(heads, monkeypatch) -> None:
    people = pretended(monkeypatch, lambda number, options: 0.05 / options.greedy.spread)
    faces = [replace(face, subject=f"person {number % 9}") for number, face in enumerate(heads)]
    chosen = choose_options(faces, AFLW21, options=OPTIONS, candidates={"spread": [1.25]})
    assert chosen.options.greedy.spread == 1.25
    assert len(people) == 2 * 3
    everybody = {face.subject for face in faces}
    assert all(learned | aside == everybody and not learned & aside for learned, aside in people)
    assert set.union(*(aside for _, aside in people)) == everybody


def test_what_may_be_chance_is_not_taken(heads, monkeypatch) -> None:
    # Much better on a few faces, and no other on the rest: the mean is lower, but of five people.
    pretended(monkeypatch, lambda number, options: 0.02 if number % 7 == 0 and options.greedy.ridge == 3 else 0.05)
    chosen = choose_options(heads, AFLW21, options=OPTIONS, candidates={"ridge": [3]}, folds=2)
    (choice,) = chosen.choices
    assert choice.error < choice.best
    assert choice.p > 0.025
    assert not choice.taken
    assert chosen.options == OPTIONS


def test_lost_faces_count_as_much_whatever_they_are_off_by(heads, monkeypatch) -> None:
    pretended(
        monkeypatch,
        lambda number, options: 3.0 if number == 0 and options.greedy.ridge == 3 else 0.05 / options.greedy.ridge,
    )
    chosen = choose_options(heads, AFLW21, options=OPTIONS, candidates={"ridge": [3, 1]}, folds=2)
    assert chosen.options.greedy.ridge == 3.0
    assert chosen.choices[0].error == pytest.approx((0.08 + 31 * 0.05 / 3) / 32)
    assert chosen.choices[1].best == pytest.approx(chosen.choices[0].error, abs=0.002)  # of the first fold or both


def test_by_default_windows_are_tried_around_those_given() -> None:
    candidates = default_candidates(OPTIONS)
    assert tuple(candidates) == choosing.OPTIONS
    for windows in candidates["windows"]:
        assert len(windows) == 2
        assert set(np.round(np.divide(windows, OPTIONS.greedy.windows), 3)) <= {0.75, 1.0, 1.2, 1.3}


@pytest.mark.parametrize(
    ("candidates", "complaint"),
    [
        ({"rank": [3]}, "candidates for ridge, variance, spread, windows; got some for rank"),
        ({"ridge": ["strong"]}, r"candidates for ridge like \[1.0\]; got \['strong'\]"),
        ({"windows": [0.5]}, r"candidates for windows like \[\(0.6, 0.4\)\]; got \[0.5\]"),
        ({"variance": [0.9, 1.5]}, "0 < variance <= 1"),
    ],
)
def test_wrong_candidates_are_refused_before_the_work(heads, monkeypatch, candidates, complaint) -> None:
    monkeypatch.setattr(choosing, "train", None)  # not reached
    with pytest.raises(InputError, match=complaint):
        choose_options(heads, AFLW21, options=OPTIONS, candidates=candidates)


def test_faces_that_cannot_be_chosen_by_are_refused_before_the_work(heads, monkeypatch) -> None:
    monkeypatch.setattr(choosing, "train", None)  # not reached
    with pytest.raises(InputError, match="folds must be from 2 to the number of subjects, 32; got 1"):
        choose_options(heads, AFLW21, options=OPTIONS, folds=1)
    with pytest.raises(InputError, match="number of subjects, 1"):
        choose_options([replace(face, subject="one") for face in heads], AFLW21, options=OPTIONS)
