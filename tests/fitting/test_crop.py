"""Crops are the same whether pictures come as files or arrays, in order, with few pictures in memory at a time."""

import threading
import time
import weakref
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
import pytest

import jaxfit
from jaxfit.data.pictures import cutting, faces_to_cut, read_image, write_image
from jaxfit.data.threads import in_order
from jaxfit.errors import InputError

FACES = 300


@pytest.fixture(scope="module")
def model():
    return jaxfit.load("sdm68")


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (40 + k, 60, 3), dtype=np.uint8) for k in range(5)]


@pytest.fixture(scope="module")
def files(pictures, tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("pictures")
    paths = [folder / f"{k}.png" for k in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        write_image(path, picture)
    return paths


def boxes(count: int) -> np.ndarray:
    return np.array([5.0, 6.0, 30.0, 30.0]) + np.arange(count)[:, None] * [0.02, 0.01, 0, 0]


def test_files_and_arrays_make_the_same_crops(model, pictures, files) -> None:
    numbers = np.arange(FACES) // 7 % len(pictures)
    made, problems = jaxfit.crop_faces(model, [pictures[k] for k in numbers], boxes(FACES))
    read, same = jaxfit.crop_faces(model, [files[k] if k % 2 else str(files[k]) for k in numbers], boxes(FACES))
    assert problems == same == {}
    for name in ("pixels", "scale", "offset"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert len(np.unique(made.pixels.reshape(FACES, -1), axis=0)) > FACES / 2


def test_a_stack_of_pictures_is_as_good_as_a_list(model) -> None:
    stack = np.random.default_rng(1).integers(0, 256, (6, 50, 60), dtype=np.uint8)
    stacked, listed = (jaxfit.crop_faces(model, images, boxes(6))[0].pixels for images in (stack, list(stack)))
    np.testing.assert_array_equal(stacked, listed)
    assert len(np.unique(stacked.reshape(6, -1), axis=0)) == 6


def test_many_faces_of_one_picture(model, pictures) -> None:
    together, problems = jaxfit.crop_faces(model, [pictures[0]] * FACES, boxes(FACES))
    copies, _ = jaxfit.crop_faces(model, [pictures[0].copy() for _ in range(FACES)], boxes(FACES))
    assert not problems
    np.testing.assert_array_equal(together.pixels, copies.pixels)


def test_readers_of_ones_own_may_fail_or_return_what_is_no_picture(model, files) -> None:
    def own(path: Path) -> np.ndarray:
        return np.array(path.stat().st_size / 1.0)

    _, problems = jaxfit.crop_faces(model, [files[0].with_name("none"), files[0], files[1]], boxes(3), read=own)
    assert sorted(problems) == [0, 1, 2]
    assert "No such file" in problems[0]
    for number in (1, 2):
        assert problems[number].startswith(f"{files[number - 1]}: expected a uint8")


def test_who_wants_no_more_has_no_more_read(model, pictures) -> None:
    begun: list[Path] = []

    def counted(path: Path) -> np.ndarray:
        begun.append(path)
        return pictures[0]

    def stopping(stage: str, done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as kept:  # which keeps the frames of what was stopped
        jaxfit.fit(model, [Path(str(k)) for k in range(5000)], boxes(5000), read=counted, progress=stopping)
    before = len(begun)
    time.sleep(0.3)
    assert 0 < len(begun) == before < 1000
    assert kept.type is KeyboardInterrupt


def test_files_that_cannot_be_read_do_not_stop_the_others(model, files, tmp_path: Path) -> None:
    torn = tmp_path / "torn.png"
    torn.write_bytes(files[0].read_bytes()[:200])
    fits = jaxfit.fit(model, [files[0], torn, tmp_path / "none.png", files[1]], [[5, 6, 30, 30]] * 3 + [[999, 0, 9, 9]])
    assert fits.ok.tolist() == [True, False, False, False]
    for number, path in {1: torn, 2: tmp_path / "none.png", 3: files[1]}.items():
        assert fits.problems[number].startswith(f"{path}: ")


def test_a_picture_is_read_once_for_faces_that_follow_one_another(model, files) -> None:
    read: list[Path] = []
    lock = threading.Lock()

    def remembering(path: Path) -> np.ndarray:
        with lock:
            read.append(path)
        return read_image(path)

    images = [files[0]] * 3 + [files[1]] + [files[0]]
    parts = in_order(cutting(faces_to_cut(model, images, boxes(5), "square", remembering), [2, 2, 1]), 3)
    assert [list(part.numbers) for part in parts] == [[0, 1], [2, 3], [4]]
    assert sorted(read) == sorted([files[0], files[1], files[0]])


def test_a_picture_that_cannot_be_read_is_tried_once_for_all_of_its_faces(model, files) -> None:
    tried: list[Path] = []

    def failing(path: Path) -> np.ndarray:
        tried.append(path)
        raise OSError("the disk is on fire")

    _, problems = jaxfit.crop_faces(model, [files[0]] * 40, boxes(40), read=failing)
    assert tried == [files[0]]
    assert problems == dict.fromkeys(range(40), f"{files[0]}: the disk is on fire")


def test_pictures_are_read_only_as_far_ahead_as_is_useful(model, pictures) -> None:
    begun: list[int] = []
    drawn: list[weakref.ref] = []

    def slow(path: Path) -> np.ndarray:
        begun.append(int(path.name))
        picture = np.ascontiguousarray(pictures[0][..., 0])
        drawn.append(weakref.ref(picture))
        return picture

    images = [Path(str(k)) for k in range(5000)]
    parts = in_order(cutting(faces_to_cut(model, images, boxes(5000), "square", slow), repeat(10)), 4)
    assert next(parts).numbers == range(10)
    assert sum(picture() is not None for picture in list(drawn)) <= 10  # of each thread this one and the last
    parts.close()
    assert len(begun) <= 60


def test_wrong_arguments_are_refused_before_anything_is_read(model) -> None:
    with pytest.raises(InputError, match="put it in a list"):
        jaxfit.crop_faces(model, "photo.jpg", [[0, 0, 9, 9]])
    with pytest.raises(InputError, match="put it in a list"):
        jaxfit.fit(model, "photo.jpg", [[0, 0, 9, 9]])
    with pytest.raises(InputError, match="one box"):
        faces_to_cut(model, ["none.jpg", "none.jpg"], [[0, 0, 9, 9]], "square", read_image)


def test_reading_in_threads_leaves_opencvs_log_as_it_was(files) -> None:
    before = cv2.utils.logging.getLogLevel()
    threads = [threading.Thread(target=lambda: [read_image(files[0]) for _ in range(50)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cv2.utils.logging.getLogLevel() == before
