"""The stream: pictures are decoded once, groups keep apart and in order, little is in memory, and it can be stopped."""

import re
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from jax import numpy as jnp
from small import Corners, random_model, with_corners

import jaxfit
from jaxfit.data.pictures import write_image
from jaxfit.data.threads import at_most_cores, reading_threads
from jaxfit.fitting import batches
from jaxfit.fitting.batches import BATCHES, batches_of, computed_at_once
from jaxfit.fitting.find import find_faces
from jaxfit.fitting.fits import Fits, Problem
from jaxfit.fitting.pipeline import Pipeline
from jaxfit.fitting.sources import NO_BOX, NO_FACE, Source
from jaxfit.fitting.stream import stream
from jaxfit.models.model import SQUARE, Model

BOX = np.array([15.0, 15.0, 60.0, 60.0])
PICTURE = np.random.default_rng(7).integers(0, 256, (90, 120), dtype=np.uint8)
PICTURES = ("a.jpg", "b.jpg", "c.jpg", "d.png", "e.png")


@pytest.fixture(scope="module")
def model() -> Model:
    return random_model("sdm")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five pictures, in each of which `Corners` finds two faces, and files that cannot be read."""
    folder = tmp_path_factory.mktemp("pictures")
    for name in PICTURES:
        picture = np.full((90, 120), 120, np.uint8)
        picture[:16, :16] = 2  # a block of JPEG's as a whole, so that it comes back exactly
        write_image(folder / name, picture)
    (folder / "torn.jpg").write_bytes((folder / "a.jpg").read_bytes()[:-40])
    (folder / "empty.png").write_bytes(b"")
    (folder / "words.png").write_bytes(b"no picture")
    (folder / "photo.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 12)
    return folder


def with_boxes(image: Any, faces: int = 1) -> Source:
    """A picture with boxes, each moved a little."""
    name = str(image) if isinstance(image, Path) else ""
    return Source(image, name, BOX + np.arange(faces)[:, None] * [0.02, 0.01, 0, 0], (SQUARE,) * faces)


def fits_of(pipeline: Pipeline, group: Sequence[Source]) -> Fits:
    """The fits of a group alone."""
    (fits,) = stream(pipeline, [group], len(group))
    return fits


def fake_find(look: Callable[[np.ndarray], None]) -> Callable:
    """Takes the place of the computation: shows the crops of each batch to ``look``, and finds zeros."""

    def find(cascade: Any, aligned: Any, confidence: Any, uncertainty: Any, crops: np.ndarray, *rest: Any) -> dict:
        look(crops)
        return {"landmarks": jnp.zeros((len(crops), 21, 2))}

    return find


GREY, COLOUR = cv2.IMREAD_GRAYSCALE, cv2.IMREAD_COLOR


@pytest.mark.parametrize(
    ("work", "of_jpeg"),
    [
        (lambda model, files: jaxfit.fit(model, files), COLOUR),
        (lambda model, files: jaxfit.fit(model, files, detector="haar"), GREY),
        (lambda model, files: jaxfit.fit(model, files, detector="whole"), GREY),
        (lambda model, files: jaxfit.fit(model, files, detector=Corners()), GREY),
        (lambda model, files: jaxfit.fit(model, files, detector=Corners(colour=True)), COLOUR),
        (lambda model, files: jaxfit.fit(model, [file.read_bytes() for file in files], detector=Corners()), GREY),
        (lambda model, files: jaxfit.fit(model, files, [BOX] * len(files)), GREY),
        (lambda model, files: jaxfit.fit(model, [file for file in files for _ in "12"], [BOX] * 2 * len(files)), GREY),
        (lambda model, files: jaxfit.crop_faces(model, files, [BOX] * len(files)), GREY),
        (lambda model, files: find_faces(files, Corners()), GREY),
        (lambda model, files: find_faces(files, Corners(colour=True)), COLOUR),
    ],
    ids=[
        "yunet",
        "haar",
        "whole",
        "grey",
        "colour",
        "bytes",
        "boxes",
        "two boxes",
        "crops",
        "found in grey",
        "found in colour",
    ],
)
def test_a_picture_is_decoded_once_and_in_grey_if_that_will_do(
    model: Model, folder: Path, monkeypatch: pytest.MonkeyPatch, work: Callable, of_jpeg: int
) -> None:
    decoded: list[int] = []
    decode = cv2.imdecode

    def counting(data: np.ndarray, flags: int) -> Any:
        decoded.append(flags)
        return decode(data, flags)

    monkeypatch.setattr(cv2, "imdecode", counting)
    monkeypatch.setattr(batches, "_find", fake_find(lambda crops: None))
    work(model, [folder / name for name in PICTURES])
    decoded = [flags & ~cv2.IMREAD_IGNORE_ORIENTATION for flags in decoded]  # turned afterwards
    assert sorted(decoded) == sorted([of_jpeg] * 3 + [COLOUR] * 2)  # other formats do not store the luminance


def test_groups_come_back_in_order_with_the_fits_that_they_have_alone(
    model: Model, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "BATCHES", (8, 1))  # of which there are large ones sooner
    groups = [
        [with_boxes(PICTURE), with_boxes(PICTURE[::-1], 3)],
        [],
        [with_boxes(PICTURE, 27), with_boxes(PICTURE[::-1], 2)],  # batches of both sizes
        [Source(with_corners(2)), Source(with_corners(0)), with_boxes(PICTURE, 19)],
        [with_boxes(PICTURE.astype(float), 2)],
        [Source(folder / name, name) for name in PICTURES],
        [with_boxes(PICTURE[:, ::-1])],
        [],
    ]
    pipeline = Pipeline(model, Corners())
    with at_most_cores(1):  # with more, there are large batches from more faces on
        together = list(stream(pipeline, groups, sum(map(len, groups))))
        assert together == [fits_of(pipeline, group) for group in groups]
    assert [len(fits) for fits in together] == [4, 0, 29, 21, 2, 10, 1, 0]
    assert len(np.unique(together[2].landmarks.reshape(29, -1), axis=0)) == 29
    assert together[5].names == PICTURES


@pytest.mark.parametrize("method", ["sdm", "regression3d"])
def test_a_group_without_pictures_has_fits_of_nobody(method: str) -> None:
    some, none = stream(Pipeline(random_model(method)), [[], []], 0)
    assert some == none
    assert (len(none), none.names, none.problems, none.sizes.shape) == (0, (), (), (0, 2))
    shapes = {"pictures": (0,), "boxes": (0, 4), "rotations": (0,), "landmarks": (0, 21, 2)}
    if method == "regression3d":
        assert none.b is not None
        shapes |= {"landmarks_3d": (0, 21, 3), "pose": (0, 3), "scale": (0,), "b": none.b.shape}
    assert {name: values.shape for name, values in none.arrays.items()} == shapes


def test_no_batch_has_faces_of_two_groups(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    computed: dict[int, list[int]] = {}

    def look(crops: np.ndarray) -> None:
        (group,) = np.unique(crops)
        computed.setdefault(int(group), []).append(len(crops))

    monkeypatch.setattr(batches, "_find", fake_find(look))
    # All of a group's pictures are of one grey, its number.
    faces = [[5], [], [1, 1, 140, 1], [16, 17], [200], [1] * 30, [3, 0, 0, 9]]
    groups = [
        [with_boxes(np.full((90, 120), number, np.uint8), each) for each in of_group]
        for number, of_group in enumerate(faces)
    ]
    with at_most_cores(1):
        fits = list(stream(Pipeline(model), groups, sum(map(len, groups))))
        expected = {number: batches_of(sum(of_group)) for number, of_group in enumerate(faces) if of_group}
    assert [len(each) for each in fits] == list(map(sum, faces))
    assert {number: sorted(sizes, reverse=True) for number, sizes in computed.items()} == expected
    assert BATCHES[0] in computed[2]


@pytest.mark.parametrize(
    ("image", "boxes", "why"),
    [
        ("torn.jpg", [BOX], "the file is truncated"),
        ("empty.png", [BOX], "the file is empty"),
        ("words.png", [BOX], "not a picture, damaged"),
        ("photo.heic", [BOX], "cannot be decoded" if find_spec("pillow_heif") else "HEIC pictures need pillow-heif"),
        ("none.png", [BOX], "cannot be read (No such file"),
        (b"", [BOX], "the picture: the file is empty"),
        (PICTURE / 255, [BOX], "got float64"),
        (PICTURE[:0], [BOX], "at least one pixel"),
        (PICTURE, [(np.nan, 0, 9, 9)], "not a finite number"),
        (PICTURE, [(9000, 0, 9, 9)], "outside the 120 x 90 picture"),
        (PICTURE, [(0, 0, 0, 9)], "no area"),
        (PICTURE, [(0, 0, 2e6, 9)], "over 1,000,000 pixels large"),
        (PICTURE, [(np.nan,) * 4], NO_BOX),
        (PICTURE, [], NO_BOX),
        ("torn.jpg", None, "the file is truncated"),
        (PICTURE / 255, None, "got float64"),
        (with_corners(0), None, NO_FACE),
    ],
)
def test_a_problem_belongs_to_its_picture_and_does_not_stop_the_others(
    model: Model, folder: Path, image: Any, boxes: list | None, why: str
) -> None:
    name = str(folder / image) if isinstance(image, str) else ""
    given = None if boxes is None else np.array(boxes, float).reshape(-1, 4)
    rows = 0 if given is None else len(given)
    bad = Source(name or image, name, given, (SQUARE,) * rows)
    pipeline, others = Pipeline(model, Corners()), (with_boxes(PICTURE), with_boxes(PICTURE[::-1], 2))
    fits = fits_of(pipeline, [others[0], bad, others[1]])
    assert fits.names == ("", name, "")
    assert fits.pictures.tolist() == [0] + [1] * rows + [2, 2]
    (problem,) = fits.problems
    assert (problem.picture, problem.name, problem.row) == (1, name, 1 if rows else None)
    assert why in problem.why
    assert not name or name not in problem.why
    np.testing.assert_array_equal(fits.fitted, fits.pictures != 1)
    np.testing.assert_array_equal(
        fits.landmarks[fits.fitted], np.concatenate([fits_of(pipeline, [other]).landmarks for other in others])
    )


def test_files_are_named_once_however_their_path_is_written(model: Model, folder: Path) -> None:
    path = f"{folder}/./none.png"
    fits = jaxfit.fit(model, [path], [BOX])
    assert list(map(str, fits.problems)) == [f"{path}: cannot be read (No such file or directory)"]


def settled(begun: list) -> int:
    """How many pictures were begun, when it is no more for a while."""
    while True:
        before = len(begun)
        time.sleep(0.15)
        if len(begun) == before:
            return before


def test_while_a_slow_consumer_waits_few_pictures_are_read(model: Model) -> None:
    begun: list[Path] = []
    drawn: list[weakref.ref] = []
    in_memory: list[int] = []

    def read(path: Path) -> np.ndarray:
        begun.append(path)
        picture = PICTURE.copy()
        drawn.append(weakref.ref(picture))
        in_memory.append(sum(each() is not None for each in drawn[-100:]))
        return picture

    endless = ([with_boxes(Path(f"{number}-{n}")) for n in range(4)] for number in count())
    threads = reading_threads(10**9)
    with closing(stream(Pipeline(model, read=read), endless, 10**9)) as results:
        for number in range(1, 6):
            assert next(results).names == tuple(f"{number - 1}-{n}" for n in range(4))
            # A group in each reading thread, one that waits for its turn, and those that are computed or wait for it.
            assert settled(begun) - 4 * number <= 4 * (threads + 2 + computed_at_once())
            assert all(picture() is None for picture in drawn)
    assert max(in_memory) <= threads


def test_while_batches_are_slow_few_pictures_are_read(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[Path] = []
    fitted: list[int] = []
    ahead: list[int] = []

    def read(path: Path) -> np.ndarray:
        begun.append(path)
        return PICTURE

    def look(crops: np.ndarray) -> None:
        time.sleep(0.02)
        ahead.append(len(begun) - sum(fitted))
        fitted.append(len(crops))

    monkeypatch.setattr(batches, "_find", fake_find(look))
    with at_most_cores(1):
        fits = fits_of(Pipeline(model, read=read), [with_boxes(Path(str(number))) for number in range(1500)])
    assert fits.fitted.all()
    assert len(begun) == sum(fitted) == 1500
    # The batches of two threads, and one that waits for its turn.
    assert max(ahead) <= 3 * BATCHES[0]


class Stop(Exception):
    pass


@pytest.mark.parametrize("stopped_by", ["its consumer", "reading", "groups", "progress", "computing"])
def test_a_stream_that_is_stopped_leaves_no_threads_and_reads_no_more(
    model: Model, monkeypatch: pytest.MonkeyPatch, stopped_by: str
) -> None:
    begun: list[Path] = []

    def stop_at(place: str, now: bool) -> None:
        if now and place == stopped_by:
            raise Stop

    def read(path: Path) -> np.ndarray:
        begun.append(path)
        stop_at("reading", len(begun) > 20)
        return PICTURE

    def groups() -> Iterator[list[Source]]:
        for number in count():
            stop_at("groups", number == 6)
            yield [with_boxes(Path(f"{number}-{n}")) for n in range(4)]

    monkeypatch.setattr(batches, "_find", fake_find(lambda crops: stop_at("computing", len(begun) > 20)))
    before = set(threading.enumerate())
    results = stream(
        Pipeline(model, read=read), groups(), 10**9, lambda stage, done, total: stop_at("progress", done > 20)
    )
    assert len(next(results)) == 4
    assert len(threading.enumerate()) > len(before)
    if stopped_by == "its consumer":
        results.close()
    else:
        with pytest.raises(Stop) as kept:  # which keeps the frames of what was stopped
            for _ in results:
                pass
        assert kept.type is Stop
    reads = len(begun)
    assert set(threading.enumerate()) <= before
    time.sleep(0.2)
    assert len(begun) == reads < 200


def test_interrupted_fits_leave_no_threads(model: Model) -> None:
    begun: list[Path] = []

    def read(path: Path) -> np.ndarray:
        begun.append(path)
        return PICTURE

    def interrupt(stage: str, done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    before, images = set(threading.enumerate()), [Path(str(number)) for number in range(3000)]
    with pytest.raises(KeyboardInterrupt):
        jaxfit.fit(model, images, [BOX] * 3000, read=read, progress=interrupt)
    for thread in {*threading.enumerate()} - before:  # which are not waited for, and end by themselves
        thread.join(30)
    assert set(threading.enumerate()) <= before
    assert 0 < len(begun) <= (reading_threads(3000) + 2) * BATCHES[0]


def test_progress_counts_the_pictures(model: Model) -> None:
    told: list[tuple[str, int, int]] = []

    def progress(stage: str, done: int, total: int) -> None:
        told.append((stage, done, total))

    groups = [[with_boxes(PICTURE)] * 5, [], [with_boxes(PICTURE, 2)] * 20]
    assert len(list(stream(Pipeline(model), groups, 25, progress))) == 3
    assert told[0] == ("fitting", 0, 25)
    assert told[-1] == ("fitting", 25, 25)
    assert told == sorted(told)


def test_a_single_picture_takes_no_thread_to_be_read(model: Model) -> None:
    threads: list[threading.Thread] = []

    def read(path: Path) -> np.ndarray:
        threads.append(threading.current_thread())
        return PICTURE

    jaxfit.fit(model, [Path("a")] * 3, [BOX] * 3, read=read)
    assert threads == [threading.current_thread()]


def test_starts_and_passes_reach_the_computation(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def find(*arguments: Any) -> dict:
        given.append(arguments)
        return fake_find(lambda crops: None)(*arguments)

    monkeypatch.setattr(batches, "_find", find)
    starts = jaxfit.Starts(5, -30.0, 40.0)
    jaxfit.fit(model, [PICTURE], [BOX], starts=starts, passes=3)
    jaxfit.fit(model, [with_corners(1)], detector=Corners(), starts=starts)
    jaxfit.fit(model, [with_corners(1)], detector=Corners(rough=False))
    jaxfit.fit(model, [PICTURE], [BOX])
    assert [each[-2] for each in given] == [3, 2, 1, 1]
    for each, expected in zip(given, (starts, starts, jaxfit.Starts(), jaxfit.Starts()), strict=True):
        np.testing.assert_array_equal(each[-3], expected.rotations)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"passes": 0}, "at least one pass"), ({"detector": Corners(kinds=("strange",))}, "'strange'")],
)
def test_pipelines_that_cannot_be_are_refused(model: Model, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(jaxfit.InputError, match=words):
        Pipeline(model, **wrong)


def test_what_python_users_hand_over_is_taken_or_refused_wherever_pictures_are(model: Model) -> None:
    pil = pytest.importorskip("PIL.Image")
    rgb = np.dstack([PICTURE] * 3)
    tensor = type("Tensor", (), {"__module__": "torch"})()
    good = [PICTURE, PICTURE.astype(np.uint16) * 257, np.asfortranarray(rgb), jnp.asarray(rgb), pil.fromarray(rgb)]
    bad = [rgb / 255, tensor, None]
    words = ["white is 1", r"torch\.Tensor", "NoneType"]
    boxes = np.tile(BOX, (len(good) + len(bad), 1))
    one = jaxfit.fit(model, [PICTURE], [BOX]).landmarks[0]

    def read(path: Path) -> Any:
        return [*good, *bad][int(path.stem)]

    files = [Path(str(number)) for number in range(len(boxes))]
    for fits in (
        jaxfit.fit(model, (image for image in [*good, *bad]), boxes),
        jaxfit.fit(model, map(str, files), boxes, read=read),
    ):
        np.testing.assert_allclose(fits.landmarks[: len(good)], np.stack([one] * len(good)), atol=1e-3)
        assert [problem.picture for problem in fits.problems] == [5, 6, 7]
        for problem, expected in zip(fits.problems, words, strict=True):
            assert re.search(expected, problem.why)
    crops, problems = jaxfit.crop_faces(model, iter([*good, *bad]), boxes)
    assert (crops.pixels[: len(good)] == crops.pixels[0]).all()
    assert [problem.row for problem in problems] == [5, 6, 7]
    assert [problem.picture for problem in find_faces(iter([*good, *bad]), Corners()).problems][-3:] == [5, 6, 7]
    frames = list(jaxfit.track(model, iter([*good, *bad]), detector=Corners()))
    assert [bool(frame.problem) for frame in frames] == [False] * 5 + [True] * 3
    for several in (tensor, pil.fromarray(rgb), rgb, 5.0):
        with pytest.raises(jaxfit.InputError, match="a sequence of images"):
            jaxfit.track(model, several)
        with pytest.raises(jaxfit.InputError, match="a sequence of images"):
            jaxfit.fit(model, several, boxes)


def test_problems_name_their_picture() -> None:
    assert str(Problem(0, "a.png", "it is empty")) == "a.png: it is empty"
    assert str(Problem(0, "", "it is empty")) == "it is empty"
