"""``jaxfit train``: what it learns from, what it writes, and what it prints."""

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from csv_files import labelled_box, read_csv, write_boxes
from drawn_faces import TRAIN
from drawn_heads import unlabelled

import jaxfit
from jaxfit.cli.labelled_faces import read_faces
from jaxfit.cli.main import main, parser
from jaxfit.data.pts import write_pts
from jaxfit.descriptors.sift import Sift
from jaxfit.heads.model import load_head_model, save_head_model
from jaxfit.labels.datasets import FORMATS
from jaxfit.labels.records import Dataset, FaceRecord
from jaxfit.learning.choose import Choice, Chosen
from jaxfit.learning.methods import Options
from jaxfit.learning.train import Trained
from jaxfit.models.model import Model
from jaxfit.schemes.known import AFLW21, NO_LANDMARKS
from jaxfit.schemes.scheme import Scheme
from jaxfit.shapes.similarity import SimilarityASM


def test_the_command_trains_as_the_library_does_and_one_seed_gives_one_file(
    drawn: Path, drawn_model: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(again), *TRAIN]) == 0
    assert again.read_bytes() == drawn_model.read_bytes()
    other = tmp_path / "other.safetensors"
    assert main(["train", "--data", f"pts:{drawn}", "--out", str(other), *TRAIN, "--seed", "1"]) == 0
    assert other.read_bytes() != drawn_model.read_bytes()


def test_the_parametric_method_with_several_starts(
    drawn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.safetensors"
    starts = ["--starts", "3", "--rotations", "-40", "40"]
    assert main(["train", "--data", f"pts:{drawn}", "--method", "parametric", *starts, "--out", str(out), *TRAIN]) == 0
    model = jaxfit.load(out)
    assert (model.training["method"], model.training["initialisations"]) == ("parametric", 3)
    descriptor, space = model.cascade.descriptor, model.cascade.space
    assert isinstance(descriptor, Sift)
    assert descriptor.orientation == "face"
    assert isinstance(space, SimilarityASM)
    assert space.size == len(space.model.deviations) + 5
    evaluate = ["evaluate", str(out), "--data", f"pts:{drawn}", *starts, "--normaliser", "box"]
    assert main([*evaluate, "--out", str(tmp_path)]) == 0
    assert np.median([float(row["nmed"]) for row in read_csv(tmp_path / "faces.csv")]) < 0.06
    picture = drawn / "face000.png"
    boxes = write_boxes(tmp_path / "boxes.csv", {picture.name: labelled_box(picture)})
    fit = ["fit", str(picture), "--model", str(out), "--boxes", str(boxes), "--out", str(tmp_path / "fits")]
    assert main([*fit, *starts]) == 0
    capsys.readouterr()
    assert main([*fit, "--starts", "0"]) == 2
    assert "expected one start" in capsys.readouterr().err


def test_labels_of_several_schemes_train_one_model_and_are_converted_to_evaluate_it(
    drawn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = (drawn / "face000.png").read_bytes()
    rng = np.random.default_rng(0)
    specs = []
    for count in (29, 68):
        folder = tmp_path / f"labelled{count}"
        folder.mkdir()
        for number in range(3):
            (folder / f"face{number:03}.png").write_bytes(picture)
            write_pts(folder / f"face{number:03}.pts", rng.uniform(30, 90, (count, 2)))
        specs.append(f"pts:{folder}")
    out = tmp_path / "model.safetensors"
    train = ["train", "--data", *specs, "--out", str(out), *TRAIN, "--windows", "0.6", "--no-detectors"]
    assert main(train) == 2
    assert "lfpw29, " in (said := capsys.readouterr().err)
    assert "--scheme can convert some" in said
    assert main([*train, "--scheme", "lfpw27"]) == 0
    assert "lfpw27, trained on 6 faces" in capsys.readouterr().out
    assert jaxfit.load(str(out)).scheme.name == "lfpw27"

    evaluate = ["evaluate", str(out), "--data", specs[1], "--out"]
    assert main([*evaluate, str(tmp_path / "a")]) == 0
    assert f"{specs[1]}: labels converted from ibug68 to the model's lfpw27" in capsys.readouterr().out
    assert main([*evaluate, str(tmp_path / "b"), "--scheme", "lfpw27"]) == 0
    assert "converted" not in capsys.readouterr().out
    assert (tmp_path / "a" / "faces.csv").read_bytes() == (tmp_path / "b" / "faces.csv").read_bytes()
    assert main([*evaluate, str(tmp_path / "c"), "--scheme", "aflw21"]) == 2
    assert "finds 27 landmarks (lfpw27)" in capsys.readouterr().err


def test_training_on_lifted_labels(
    heads: tuple[FaceRecord, ...],
    head_models: dict[str, Model],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Faces with hidden points join those with all; training itself is replaced: this looks at what it gets."""
    for face in heads[:3]:
        (tmp_path / face.image.name).write_bytes(face.image.read_bytes())
        write_pts((tmp_path / face.image.name).with_suffix(".pts"), face.landmarks)
    hidden = [replace(face, present=np.arange(21) % 4 > 0) for face in heads[3:9]]
    hidden[5] = replace(hidden[5], present=np.arange(21) < 7)
    monkeypatch.setitem(FORMATS, "hidden", lambda _: Dataset("", AFLW21, tuple(hidden), ("one more was torn",)))
    asked: dict[str, Any] = {}

    def train(faces: Sequence[FaceRecord], scheme: Scheme, **others: Any) -> Trained:
        asked.update(others, faces=faces, scheme=scheme)
        return Trained(head_models["regression3d"], len(faces), ())

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    head, out = tmp_path / "head.safetensors", tmp_path / "out.safetensors"
    save_head_model(load_head_model(), head)
    command = [
        "train",
        "--data",
        f"pts:{tmp_path}",
        "--lift",
        "hidden:x",
        "--out",
        str(out),
        "--method",
        "regression3d",
    ]
    assert main([*command, "--head-model", str(head), "--lift-yaw", "9"]) == 0
    turned = [face for face in hidden[:5] if face.pose is not None and abs(face.pose[2]) > 9]
    assert 0 < len(turned) < 5
    assert (asked["method"], asked["scheme"], asked["options"].head_model) == ("regression3d", AFLW21, str(head))
    assert [face.face for face in asked["faces"]] == [face.face for face in [*heads[:3], *turned]]
    for lifted, face in zip(asked["faces"][3:], turned, strict=True):
        assert lifted.complete
        apart = np.linalg.norm(lifted.landmarks - face.landmarks, axis=1)  # hidden ones included
        assert apart.max() < 0.05 * np.ptp(face.landmarks, 0).max()
        assert lifted.pose is not None
        assert face.pose is not None
        np.testing.assert_allclose(lifted.pose, face.pose, atol=5)
    said = capsys.readouterr()
    assert f"hidden:x: {len(turned)} of 6 faces lifted to aflw21" in said.out
    assert f"trained on {3 + len(turned)} faces" in said.out
    for words in ("one more was torn", "1 of 6 faces left out: fewer than 8 labelled points", "turned by less than 9"):
        assert words in said.err
    assert jaxfit.load(out).space_3d is not None

    # A head model knows neither faces without landmarks nor points of unknown meaning.
    monkeypatch.setitem(FORMATS, "hidden", lambda _: Dataset("", NO_LANDMARKS, tuple(map(unlabelled, heads[:2]))))
    assert main(command) == 2
    assert "this head model has no points of scheme none" in capsys.readouterr().err
    assert main([*command, "--head-model", "nobody"]) == 2
    assert "no head model 'nobody': expected one of the bundled head models" in capsys.readouterr().err


def test_training_on_filled_labels_with_a_confidence(
    heads: tuple[FaceRecord, ...],
    head_models: dict[str, Model],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Incomplete faces join the training if asked to, and both it and the confidence learn from the same faces."""
    hidden = [replace(face, present=np.arange(21) % 4 > 0) for face in heads[3:5]]
    faces = (*heads[:3], *hidden)
    monkeypatch.setitem(FORMATS, "some", lambda _: Dataset("", AFLW21, faces))
    learned: list[list[str]] = []
    taught: list[tuple[int, list[tuple[str, str]]]] = []

    def train(faces: Sequence[FaceRecord], scheme: Scheme, **_: Any) -> Trained:
        learned.append([face.face for face in faces if face.complete])
        return Trained(head_models["regression3d"], len(faces), ())

    def learn_confidence(model: Model, faces: Sequence[FaceRecord], folds: int, **_: Any) -> Model:
        taught.append((folds, [(face.subject, face.face) for face in faces if face.complete]))
        return replace(model, training=model.training | {"taught": True})

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    monkeypatch.setattr("jaxfit.cli.train.learn_confidence", learn_confidence)
    out = tmp_path / "m.safetensors"
    for more in ([], ["--fill"], ["--fill", "--confidence"], ["--confidence", "5"]):
        assert main(["train", "--data", "some:x", "--out", str(out), *more]) == 0
        assert ("taught" in jaxfit.load(out).training) == ("--confidence" in more)
    names = [face.face for face in faces]
    assert learned == [names[:3], names, names, names[:3]]
    # Who bears one name in two datasets is two people.
    ids = [(f"0/{face.subject}", face.face) for face in faces]
    assert taught == [(3, ids), (5, ids[:3])]
    for folds in ("-1", "0", "1"):
        for option in ("--confidence", "--choose"):
            assert main(["train", "--data", "some:x", "--out", str(out), option, folds]) == 2
            assert f"{option}: expected 2 folds or more" in capsys.readouterr().err


def test_training_with_chosen_options(
    drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[int, float, int, str]] = []

    def choose_options(
        faces: Sequence[FaceRecord], scheme: Scheme, *, options: Options, folds: int, method: str, **_: Any
    ) -> Chosen:
        asked.append((len(faces), options.greedy.ridge, folds, method))
        choices = (Choice("ridge", 3.0, 0.04, 0.05, 12, 0.001, True),)
        return Chosen(options.but(ridge=3.0), choices, folds)

    monkeypatch.setattr("jaxfit.cli.train.choose_options", choose_options)
    out = tmp_path / "m.safetensors"
    train = ["train", "--data", f"pts:{drawn}", "--out", str(out), *TRAIN, "--no-detectors"]
    assert main([*train, "--choose", "--ridge", "2"]) == 0
    training = jaxfit.load(out).training
    assert asked == [(training["faces"], 2.0, 3, "sdm")]
    assert (training["ridge"], training["chosen"]["trials"][0]["faces"]) == (3.0, 12)
    said = capsys.readouterr().out
    assert re.search(r"ridge +3 +12 +0\.0400 +0\.0500 +0\.001 +yes", said)
    assert "chosen: ridge 3, variance 0.95, spread 1, windows " in said


def test_training_without_the_pictures_of_the_test(
    heads: tuple[FaceRecord, ...],
    head_models: dict[str, Model],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Training itself is replaced: this looks at what it gets."""
    elsewhere = [replace(face, image=tmp_path / "cut" / face.image.name, face="other") for face in heads[1:3]]
    shutil.copy(heads[5].image, tmp_path / "renamed.png")
    elsewhere.append(replace(heads[5], image=tmp_path / "renamed.png"))
    monkeypatch.setitem(FORMATS, "drawn", lambda _: Dataset("", AFLW21, heads[:6]))
    monkeypatch.setitem(FORMATS, "tested", lambda _: Dataset("", NO_LANDMARKS, tuple(map(unlabelled, elsewhere))))
    learned: list[FaceRecord] = []

    def train(faces: Sequence[FaceRecord], scheme: Scheme, **_: Any) -> Trained:
        learned.extend(faces)
        return Trained(head_models["regression3d"], len(faces), ())

    monkeypatch.setattr("jaxfit.cli.train.train", train)
    assert main(["train", "--data", "drawn:x", "--without", "tested:x", "--out", str(tmp_path / "m.safetensors")]) == 0
    assert [face.face for face in learned] == [face.face for face in (heads[0], *heads[3:5])]
    said = capsys.readouterr().out
    assert "3 of 6 faces left out: tested:x has their pictures; some by their names, such as" in said
    assert f"; some by their pixels, such as {heads[5].image} for {tmp_path / 'renamed.png'}" in said


def test_a_person_who_is_lifted_and_shared_is_one_person(
    heads: tuple[FaceRecord, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that nobody is both learned from and kept aside."""
    for name in ("here", "there"):
        monkeypatch.setitem(FORMATS, name, lambda _: Dataset("", AFLW21, tuple(heads[:4]), ()))
    specs = {"--data": f"here:{tmp_path}", "--lift": "there:x", "--share": "there:x"}
    words = ["finetune", "model", "--out", "out", *(word for option in specs.items() for word in option)]
    faces = read_faces(parser().parse_args(words)).faces
    assert len(faces) == 12
    subjects = [face.subject for face in faces]
    assert subjects[4:8] == subjects[8:]
    assert not set(subjects[:4]) & set(subjects[4:])


def test_3d_methods_need_a_head_model_of_the_landmarks(
    drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("jaxfit.learning.prepare.cut", None)  # not reached
    out = tmp_path / "out.safetensors"
    for method in ("alignment3d", "regression3d"):
        train = ["train", "--data", f"pts:{drawn}", "--out", str(out), *TRAIN, "--no-detectors", "--method", method]
        assert main(train) == 2
        assert "this head model has no points of scheme points5; it has" in capsys.readouterr().err
    assert not out.exists()
