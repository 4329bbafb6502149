"""Crops are the same whether pictures come as files or arrays, and what cannot be cut is said of its face."""

import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

import jaxfit
from jaxfit.data.pictures import Image, read_image, write_image
from jaxfit.errors import InputError
from jaxfit.fitting.fits import Problem
from jaxfit.models.model import Model

FACES = 300


@pytest.fixture(scope="module")
def model() -> Model:
    return jaxfit.load("sdm68")


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (40 + k, 60, 3), dtype=np.uint8) for k in range(5)]


@pytest.fixture(scope="module")
def files(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("pictures")
    paths = [folder / f"{k}.png" for k in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        write_image(path, picture)
    return paths


def boxes(count: int) -> np.ndarray:
    return np.array([5.0, 6.0, 30.0, 30.0]) + np.arange(count)[:, None] * [0.02, 0.01, 0, 0]


def test_files_and_arrays_make_the_same_crops(model: Model, pictures: list[np.ndarray], files: list[Path]) -> None:
    numbers = np.arange(FACES) // 7 % len(pictures)
    made, problems = jaxfit.crop_faces(model, [pictures[k] for k in numbers], boxes(FACES))
    read, same = jaxfit.crop_faces(model, [files[k] if k % 2 else str(files[k]) for k in numbers], boxes(FACES))
    assert problems == same == ()
    for name in ("pixels", "scale", "offset"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert len(np.unique(made.pixels.reshape(FACES, -1), axis=0)) > FACES / 2


def test_a_stack_of_pictures_is_as_good_as_a_list(model: Model) -> None:
    stack = np.random.default_rng(1).integers(0, 256, (6, 50, 60), dtype=np.uint8)
    stacked, listed = (jaxfit.crop_faces(model, images, boxes(6))[0].pixels for images in (stack, list(stack)))
    np.testing.assert_array_equal(stacked, listed)
    assert len(np.unique(stacked.reshape(6, -1), axis=0)) == 6


def test_many_faces_of_one_picture(model: Model, pictures: list[np.ndarray]) -> None:
    together, problems = jaxfit.crop_faces(model, [pictures[0]] * FACES, boxes(FACES))
    copies, _ = jaxfit.crop_faces(model, [pictures[0].copy() for _ in range(FACES)], boxes(FACES))
    assert not problems
    np.testing.assert_array_equal(together.pixels, copies.pixels)


def test_no_faces_have_no_crops(model: Model) -> None:
    crops, problems = jaxfit.crop_faces(model, [], [])
    assert (len(crops), problems) == (0, ())


def test_problems_are_of_their_faces(model: Model, pictures: list[np.ndarray], files: list[Path]) -> None:
    images: list[Image] = [files[0], files[0], files[1].with_name("none.png"), pictures[0], files[1]]
    places = boxes(5)
    places[1], places[3] = (999, 0, 9, 9), np.nan
    crops, problems = jaxfit.crop_faces(model, images, places)
    assert [(problem.picture, problem.row, problem.name) for problem in problems] == [
        (1, 1, str(files[0])),
        (2, 2, str(images[2])),
        (3, 3, ""),
    ]
    for problem, why in zip(problems, ("outside", "cannot be read", "no face box"), strict=True):
        assert why in problem.why
    assert crops.pixels.any((1, 2)).tolist() == [True, False, False, False, True]


def test_readers_of_ones_own_may_fail_or_return_what_is_no_picture(model: Model, files: list[Path]) -> None:
    def own(path: Path) -> np.ndarray:
        return np.array(path.stat().st_size / 1.0)

    images = [files[0].with_name("none"), files[0], files[1]]
    _, problems = jaxfit.crop_faces(model, images, boxes(3), read=own)
    assert [(problem.row, problem.name) for problem in problems] == list(enumerate(map(str, images)))
    assert "No such file" in problems[0].why
    assert [problem.why.startswith("expected a uint8") for problem in problems] == [False, True, True]


def test_a_picture_is_read_once_for_faces_that_follow_one_another(model: Model, files: list[Path]) -> None:
    read: list[Path] = []

    def remembering(path: Path) -> np.ndarray:
        read.append(path)
        return read_image(path)

    images: list[Image] = [files[0], str(files[0]), files[0], files[1], files[0]]
    _, problems = jaxfit.crop_faces(model, images, boxes(5), read=remembering)
    assert not problems
    assert sorted(read) == sorted([files[0], files[1], files[0]])


def test_a_picture_that_cannot_be_read_is_tried_once_for_all_of_its_faces(model: Model, files: list[Path]) -> None:
    tried: list[Path] = []

    def failing(path: Path) -> np.ndarray:
        tried.append(path)
        raise OSError("the disk is on fire")

    _, problems = jaxfit.crop_faces(model, [files[0]] * 40, boxes(40), read=failing)
    assert tried == [files[0]]
    assert problems == tuple(Problem(number, str(files[0]), "the disk is on fire", number) for number in range(40))


def test_wrong_arguments_are_refused_before_anything_is_read(model: Model) -> None:
    with pytest.raises(InputError, match="put it in a list"):
        jaxfit.crop_faces(model, "photo.jpg", [[0, 0, 9, 9]])
    with pytest.raises(InputError, match="one box"):
        jaxfit.crop_faces(model, ["none.jpg", "none.jpg"], [[0, 0, 9, 9]])
    with pytest.raises(InputError, match="knows boxes of the kinds"):
        jaxfit.crop_faces(model, ["none.jpg"], [[0, 0, 9, 9]], kind="mine")


def test_reading_in_threads_leaves_opencvs_log_as_it_was(files: list[Path]) -> None:
    before = cv2.utils.logging.getLogLevel()
    threads = [threading.Thread(target=lambda: [read_image(files[0]) for _ in range(50)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cv2.utils.logging.getLogLevel() == before


def test_the_functions_inside_take_crops_of_uint8_only() -> None:
    """In a process of its own: here, types are checked before anything is called."""
    code = """import jaxfit, numpy
cascade = jaxfit.load("fast68").cascade
try: jaxfit.cascade.fit_crops(cascade, numpy.zeros((1, cascade.frame.crop, cascade.frame.crop), numpy.float32))
except jaxfit.InputError as error: print(error)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "expected uint8 crops, as jaxfit.crop_faces cuts them; got float32\n"
