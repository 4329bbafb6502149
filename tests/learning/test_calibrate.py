"""A new kind of box is learned from pictures that have no landmarks."""

# What may be None or has many types in the library has one here, which the assertions show.
# mypy: disable-error-code="union-attr"

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jaxfit
from jaxfit.data.detectors import detect_faces
from jaxfit.data.pictures import write_image
from jaxfit.labels.records import FaceRecord
from jaxfit.learning.placements import calibrate_boxes, evaluate_in_own_boxes, frontal
from jaxfit.schemes.known import NO_LANDMARKS, scheme_named

FACES = 10


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    cbook = pytest.importorskip("matplotlib.cbook")
    return jaxfit.read_image(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False))


@pytest.fixture(scope="module")
def boxed(portrait: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> list[FaceRecord]:
    """The portrait, cut differently; boxes are the detector's, moved right by a tenth, half as large."""
    folder = tmp_path_factory.mktemp("boxed")
    records = []
    for number in range(FACES):
        picture = portrait[3 * number :, 2 * number :]
        write_image(folder / f"{number}.png", picture)
        (found,) = jaxfit.detect_faces(picture, "haar")
        x, y, width, height = found.box
        box = np.array([x + width / 4 + width / 10, y + height / 4, width / 2, height / 2])
        records.append(_record(folder / f"{number}.png", box))
    return records


def _record(image: Path, box: np.ndarray | None) -> FaceRecord:
    none = np.zeros(NO_LANDMARKS.count, bool)
    return FaceRecord(image, np.zeros((0, 2)), none, none, box, None, image.stem, image.stem)


def test_boxes_moved_and_shrunk_are_placed_back(boxed: list[FaceRecord], portrait: np.ndarray) -> None:
    model = jaxfit.load("sdm68")
    learned, known = calibrate_boxes(model, boxed).placement, model.placement("haar-frontal")
    (found,) = jaxfit.detect_faces(portrait, "haar")
    x, y, width, height = found.box
    box = np.array([x + width / 4 + width / 10, y + height / 4, width / 2, height / 2])
    centre, side = learned.face_in(box)
    # One person's face need not lie in its box as faces do on average, but nearly.
    expected_centre, expected_side = known.face_in(found.box)
    np.testing.assert_allclose(centre, expected_centre, atol=0.12 * width)
    assert side == pytest.approx(expected_side, rel=0.15)
    # Better still: from the learned kind of box the fit is the one from the detector's.
    taught = replace(model, placements={**model.placements, "mine": learned})
    fits = jaxfit.fit(taught, [portrait, portrait], [box, found.box], kind=["mine", "haar-frontal"])
    apart = np.linalg.norm(fits.landmarks[0] - fits.landmarks[1], axis=1).mean()
    assert apart < 0.02 * width


def test_what_cannot_be_measured_is_left_out_until_too_little_is_left(boxed: list[FaceRecord], tmp_path: Path) -> None:
    model = jaxfit.load("sdm68")
    blank = tmp_path / "blank.png"
    write_image(blank, np.full((200, 200), 90, np.uint8))
    others = [_record(tmp_path / "none.png", boxed[0].box), _record(blank, boxed[0].box), _record(boxed[0].image, None)]
    calibrated, usual = calibrate_boxes(model, boxed + others), calibrate_boxes(model, boxed)
    assert (calibrated.placement, calibrated.faces) == (usual.placement, FACES)
    (problem,) = calibrated.problems
    assert problem.startswith(f"{tmp_path / 'none.png'}: ")
    assert usual.problems == ()
    with pytest.raises(jaxfit.InputError, match="at least 10 faces that the detector finds in their boxes; found 3"):
        calibrate_boxes(model, boxed[:3] + others)


def test_models_that_do_not_know_the_detector_are_refused(boxed: list[FaceRecord]) -> None:
    model = jaxfit.load("sdm68")
    # Of landmarks that nobody has measured boxes for, either.
    stranger = replace(model, scheme=scheme_named("points68"), placements={"square": model.placement("square")})
    with pytest.raises(jaxfit.InputError, match="haar-frontal"):
        calibrate_boxes(stranger, boxed)


def test_only_heads_that_look_ahead_tell_how_faces_lie(boxed: list[FaceRecord]) -> None:
    turned = [replace(boxed[0], pose=np.array(pose)) for pose in ([40.0, 0, 0], [0, 30.0, 0], [0, 0, -30.0])]
    assert [frontal(face) for face in (boxed[0], *turned)] == [True, True, False, False]


def test_who_is_tested_does_not_tell_how_boxes_lie(boxed: list[FaceRecord], monkeypatch: pytest.MonkeyPatch) -> None:
    model = jaxfit.load("sdm68")
    looked, measured = [], []

    def detected(grey: np.ndarray, name: str) -> list:
        looked.append(grey.shape)
        return detect_faces(grey, name)

    def measure(boxes, landmarks, mean, face):
        measured.append(boxes.tolist())
        return model.placement("square")

    monkeypatch.setattr("jaxfit.learning.placements.detect_faces", detected)
    monkeypatch.setattr("jaxfit.learning.placements.measure_placement", measure)
    monkeypatch.setattr("jaxfit.learning.placements._FEWEST", 2)
    people = [replace(face, subject=f"person{number % 2}") for number, face in enumerate(boxed[:4])]
    turned = replace(people[1], pose=np.array([0.0, 0.0, 60.0]), face="turned")
    lost = replace(people[0], image=Path("missing.png"), face="lost")
    (result,) = evaluate_in_own_boxes({"mine": model}, [*people, turned, lost], model).values()
    assert len(looked) == 4  # at each picture that looks ahead, once
    assert measured == [[boxed[1].box.tolist(), boxed[3].box.tolist()], [boxed[0].box.tolist(), boxed[2].box.tolist()]]
    assert [face.face for face in result.faces] == ["0", "2", "lost", "1", "3", "turned"]
    assert [problem.row for problem in result.fits.problems] == [2]
    assert np.isfinite(result.landmarks[[0, 1, 3, 4, 5]]).all()
    assert np.isnan(result.landmarks[2]).all()
    assert result.fits.pose is None
    assert result.seconds_per_face > 0
    with pytest.raises(jaxfit.InputError, match="two subjects or more"):
        evaluate_in_own_boxes({"mine": model}, people[::2], model)
