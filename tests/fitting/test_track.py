"""Tracking: who is who through made videos of drawn and of real faces, and what is said of bad input."""

import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest

import jaxfit
from jaxfit.data.boxes import bounding_square, box_centre
from jaxfit.data.detectors import Detection
from jaxfit.data.detectors.detector import overlap
from jaxfit.data.pictures import read_grey, to_grey
from jaxfit.errors import InputError
from jaxfit.evaluation.errors import nmed
from jaxfit.fitting import OneEuro, TrackedFrame, Tracker
from jaxfit.fitting.fits import Fits
from jaxfit.models.model import SQUARE, Model
from jaxfit.schemes.known import IBUG68, scheme_named

SIDE = 60.0
PEOPLE = {"ann": 200, "bob": 100, "eve": 150}  # and the grey of their faces


class World:
    """Squares of one grey on black stand in for faces: a fit finds the square that its box overlaps, exactly.

    What it does not find has landmarks that stay in the box, with little confidence where there is any.
    """

    kinds = (SQUARE,)
    colour = False
    rough = False

    def __init__(self) -> None:
        self.looks = 0
        self.confidence: float | None = None
        self.blind = False

    def __call__(self, image: np.ndarray) -> list[Detection]:
        self.looks += 1
        return [] if self.blind else [Detection(square, SQUARE) for square in self.squares(image)]

    @staticmethod
    def squares(image: np.ndarray) -> list[np.ndarray]:
        found = []
        for grey in PEOPLE.values():
            rows, columns = np.nonzero(np.abs(to_grey(image).astype(int) - grey) <= 5)
            if len(rows) > 100:
                low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()])
                found.append(np.array([*low, *(high - low)], float))
        return found

    def fit(
        self,
        model: object,
        images: Sequence[np.ndarray],
        boxes: Sequence[np.ndarray],
        kind: object = SQUARE,
        rotations: object = None,
    ) -> Fits:
        confidences = np.full(len(images), np.nan if self.confidence is None else self.confidence)
        landmarks = np.full((len(images), 4, 2), np.nan)
        for row, (image, box) in enumerate(zip(images, boxes, strict=True)):
            overlaps = [(overlap(square, box), tuple(square)) for square in self.squares(image)]
            best, square = max(overlaps, default=(0.0, tuple(box)))
            if best <= 0.2:
                confidences[row] = 0.1
            x, y, width, height = square if best > 0.2 else box
            landmarks[row] = [[x, y], [x + width, y], [x, y + height], [x + width, y + height]]
        return Fits(
            scheme=scheme_named("points4"),
            names=("",) * len(images),
            sizes=np.array([image.shape[1::-1] for image in images], int).reshape(-1, 2),
            pictures=np.arange(len(images)),
            boxes=np.array(boxes, float).reshape(-1, 4),
            kinds=(SQUARE,) * len(images),
            rotations=np.zeros(len(images)),
            landmarks=landmarks,
            confidence=None if self.confidence is None else confidences,
        )


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    world, module = World(), import_module("jaxfit.fitting.track")
    monkeypatch.setattr(module, "fit", world.fit)
    monkeypatch.setattr(module, "upright_rotation", lambda model, landmarks: 0.0)
    return world


@pytest.fixture(scope="module")
def model() -> Model:
    return jaxfit.load("fast68")


def scene(**places: tuple[float, float] | None) -> np.ndarray:
    """A frame (240, 320) with people's faces at these centres; None: not there."""
    frame = np.zeros((240, 320), np.uint8)
    for name, place in places.items():
        if place is not None:
            low = np.round(np.array(place) - SIDE / 2).astype(int)
            x, y = np.maximum(low, 0)
            frame[y : low[1] + int(SIDE), x : low[0] + int(SIDE)] = PEOPLE[name]
    return frame


def ids(frame: TrackedFrame) -> list[int]:
    """Who is in a frame, each with a face."""
    assert len(frame.faces) == len(frame.ids) == len(frame.ages)
    return frame.ids.tolist()


def test_people_keep_their_numbers_without_the_detector(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=1000)
    for k in range(40):
        frame = tracker.update(scene(ann=(60 + 2 * k, 100), bob=(250 - k, 180)))
        at = dict(zip(ids(frame), map(box_centre, frame.faces.boxes), strict=True))
        if not k:
            (ann,) = [number for number, centre in at.items() if abs(centre[0] - 60) < 2]
        np.testing.assert_allclose(at[ann], [60 + 2 * k, 100], atol=1)
        np.testing.assert_allclose(at[3 - ann], [250 - k, 180], atol=1)
        assert frame.ages.tolist() == [k + 1, k + 1]
        assert frame.faces.pictures.tolist() == [0, 0]
        assert (frame.faces.names, frame.faces.sizes.tolist()) == (("",), [[320, 240]])
    assert (world.looks, tracker.people) == (1, 2)


def test_fast_faces_are_met_where_they_go(world: World, model: Model) -> None:
    """Once it is known how it moves, a face may move on by more than its fits could bridge from where it was."""
    tracker = Tracker(model, world, redetect_every=1000)
    x, step = 40.0, 0.0
    while x < 280:
        assert ids(tracker.update(scene(ann=(x, 120)))) == [1]
        step += 8
        x += step
    assert step > 0.6 * SIDE


def test_newcomers_are_found_in_time(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=5)
    first = None
    for k in range(14):
        frame = tracker.update(scene(ann=(60, 100), bob=(200, 100) if k >= 6 else None))
        first = k if first is None and len(frame.faces) == 2 else first
    assert first == 10
    assert ids(frame) == [1, 2]
    assert frame.ages.tolist() == [14, 4]


@pytest.mark.parametrize(
    ("absent", "back", "same"), [(20, (80, 100), True), (100, (60, 100), False), (20, (160, 60), False)]
)
def test_who_leaves_is_lost_and_soon_back_under_the_same_number(
    world: World, model: Model, absent: int, back: tuple[int, int], same: bool
) -> None:
    tracker = Tracker(model, world)
    world.confidence = 0.9
    frames = [scene(ann=(60, 100))] * 3 + [scene()] * absent + [scene(ann=back)] * 5
    seen = [ids(tracker.update(frame)) for frame in frames]
    assert seen == [[1]] * 3 + [[]] * absent + seen[-5:]
    assert seen[-1] == ([1] if same else [2])


@pytest.mark.parametrize(("confidence", "reported", "searches"), [(0.4, True, False), (0.2, False, True)])
def test_confidence_has_to_be_higher_to_begin_than_to_go_on(
    world: World, model: Model, confidence: float, reported: bool, searches: bool
) -> None:
    tracker = Tracker(model, world, redetect_every=1000)
    world.confidence = confidence
    assert ids(tracker.update(scene(ann=(60, 100)))) == []  # not sure enough to begin
    world.confidence = 0.9
    while not ids(tracker.update(scene(ann=(60, 100)))):
        pass
    looks, world.confidence = world.looks, confidence
    for _ in range(10):
        assert bool(ids(tracker.update(scene(ann=(60, 100))))) == reported
    assert (world.looks > looks) == searches
    world.confidence = 0.9
    for _ in range(4):
        frame = tracker.update(scene(ann=(60, 100)))
    assert ids(frame) == [1]  # also after a while of doubt


def test_a_moment_of_doubt_is_no_loss(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=1000)
    for confidence in (0.9, 0.9, 0.1, 0.1, 0.9):
        world.confidence = confidence
        assert bool(ids(tracker.update(scene(ann=(60, 100))))) == (confidence > 0.5)
    assert world.looks == 1


def test_of_two_tracks_on_one_face_the_older_stays(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=4)
    for k in range(30):  # bob passes behind ann, whose face is drawn over his
        frame = scene(bob=(250 - 5 * k, 110))
        squares = tracker.update(np.where(scene(ann=(150, 100)) > 0, scene(ann=(150, 100)), frame)).faces.boxes
        assert all(overlap(a, b) < 0.5 for i, a in enumerate(squares) for b in squares[:i])


def test_without_confidence_the_detector_has_to_agree_from_time_to_time(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=5)
    for _ in range(31):
        assert ids(tracker.update(scene(ann=(60, 100)))) == [1]
    world.blind = True
    seen = [bool(ids(tracker.update(scene(ann=(60, 100))))) for _ in range(40)]
    assert all(seen[:15])
    assert not any(seen[25:])


def test_after_a_cut_everybody_is_somebody_else(world: World, model: Model) -> None:
    rng = np.random.default_rng(0)
    scenes = [
        cv2.resize(rng.integers(0, 90, (6, 8), np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST) for _ in "ab"
    ]
    scenes[1] = 90 - scenes[0]
    tracker = Tracker(model, world, redetect_every=1000)
    seen = []
    for k in range(12):
        face = scene(ann=(60, 100))
        seen.append(ids(tracker.update(np.where(face > 0, face, scenes[k >= 6]))))
    assert seen == [[1]] * 6 + [[2]] * 6


def test_a_flash_is_no_cut(world: World, model: Model) -> None:
    tracker = Tracker(model, world, redetect_every=1000)
    for light in (0, 0, 90, 0):
        face = scene(ann=(60, 100))
        assert ids(tracker.update(np.where(face > 0, face, np.uint8(light)))) == [1]


def test_bad_frames_and_arguments(world: World, model: Model) -> None:
    frames = [
        scene(ann=(60, 100)),
        np.zeros((0, 3), np.uint8),
        scene(ann=(62, 100)).astype(float),
        scene(ann=(62, 100)),
    ]
    tracked = list(jaxfit.track(model, frames, detector=world))
    assert [ids(frame) for frame in tracked] == [[1], [], [], [1]]
    assert [frame.number for frame in tracked] == [0, 1, 2, 3]
    assert all(frame.picture is picture for frame, picture in zip(tracked, frames, strict=True))
    assert [bool(frame.problem) for frame in tracked] == [False, True, True, False]
    assert "frame 1: expected a uint8" in tracked[1].problem
    assert list(jaxfit.track(model, [], detector=world)) == []
    tracker = Tracker(model, world)
    tracker.update(frames[0], 1.0)
    with pytest.raises(InputError, match=r"after 1.0 s; got one of 1.0 s"):
        tracker.update(frames[0], 1.0)
    for call, expected in (
        (lambda: Tracker(model, "nobody"), "expected a detector"),
        (lambda: Tracker(model, world, redetect_every=0), "1 frame or more"),
        (lambda: jaxfit.track(model, frames, frame_rate=0.0), "frame rate above 0"),
        (lambda: jaxfit.track(model, frames[0]), "put it in a list"),
        (lambda: jaxfit.track(model, "missing.mp4"), "there is no file"),
    ):
        with pytest.raises(InputError, match=expected):
            call()


def test_a_file_that_was_cut_short_is_tracked_and_warned_of(world: World, model: Model, tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "whole.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (320, 240))
    for _ in range(20):
        writer.write(cv2.cvtColor(scene(ann=(60, 100)), cv2.COLOR_GRAY2BGR))
    writer.release()
    data = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    with pytest.warns(UserWarning, match="frames could be read"):
        frames = list(jaxfit.track(model, tmp_path / "cut.avi", detector=world))
    assert 0 < len(frames) < 20
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(list(jaxfit.track(model, tmp_path / "whole.avi", detector=world))) == 20


@pytest.fixture(scope="module")
def walk(real_dataset: Callable) -> tuple[list[np.ndarray], np.ndarray]:
    """24 frames of a real face that moves, grows and turns a little, and its landmarks (24, 68, 2)."""
    face = real_dataset("pts:helen68").faces[0]
    grey = read_grey(face.image)
    square = bounding_square(face.landmarks)
    rng = np.random.default_rng(0)
    frames, truth = [], []
    for k in range(24):
        cos, sin = np.cos(np.radians(k - 12)), np.sin(np.radians(k - 12))
        turned = 120 * 1.01**k / square[2] * np.array([[cos, -sin], [sin, cos]])
        offset = np.array([130 + 3.0 * k, 150]) - turned @ (square[:2] + square[2:] / 2)
        frame = cv2.warpAffine(
            grey, np.c_[turned, offset], (360, 300), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE
        )
        frames.append(np.clip(frame + rng.normal(0, 3, frame.shape), 0, 255).astype(np.uint8))
        truth.append(face.landmarks @ turned.T + offset)
    return frames, np.array(truth)


def landmarks_of(model: Model, frames: Sequence[np.ndarray], smoothing: OneEuro | None) -> np.ndarray:
    tracked = list(jaxfit.track(model, frames, redetect_every=1000, smoothing=smoothing))
    assert [ids(frame) for frame in tracked] == [[1]] * len(frames)
    return np.concatenate([frame.faces.landmarks for frame in tracked])


def test_a_real_face_is_followed_and_smoothing_calms_it(model: Model, walk: tuple) -> None:
    frames, truth = walk
    plain = landmarks_of(model, frames, None)
    assert nmed(plain, truth, IBUG68).max() < 0.08
    calm = landmarks_of(model, frames, OneEuro())
    assert nmed(calm, truth, IBUG68).max() < 0.08
    shaken = [np.diff(points - truth, 2, axis=0).std() for points in (plain, calm)]
    assert shaken[1] < 0.8 * shaken[0]


def test_heads_are_tracked_in_3d(walk: tuple) -> None:
    frames, _ = walk
    model = jaxfit.load("regression68-3d")
    plain, calm = (
        Fits.join([frame.faces for frame in jaxfit.track(model, frames[:12], smoothing=how)]).arrays
        for how in (None, OneEuro())
    )
    assert plain["landmarks_3d"].shape == (12, 68, 3)
    assert np.polyfit(np.arange(12), plain["pose"][:, 0], 1)[0] == pytest.approx(
        1, abs=0.3
    )  # a degree a frame, clockwise
    np.testing.assert_allclose(calm["pose"], plain["pose"], atol=5)
    np.testing.assert_array_equal(calm["scale"], plain["scale"])
    assert not np.array_equal(calm["landmarks_3d"], plain["landmarks_3d"])
