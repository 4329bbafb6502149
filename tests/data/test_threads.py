"""Work in threads: results in the order of the work, few pieces at a time, and nothing after the end is asked for."""

import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial

import pytest

from jaxfit.data.threads import at_most_cores, cores, in_order, reading_threads

PATIENCE = 60  # seconds to wait for another thread


@pytest.mark.parametrize("threads", [0, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 20])
def test_results_come_in_the_order_of_the_work(count: int, threads: int) -> None:
    assert list(in_order((partial(pow, number, 2) for number in range(count)), threads)) == [
        n * n for n in range(count)
    ]


def test_a_later_piece_that_is_done_first_waits_for_its_turn() -> None:
    second_is_done = threading.Event()

    def second() -> int:
        second_is_done.set()
        return 2

    assert list(in_order([lambda: second_is_done.wait(PATIENCE), second], 2)) == [True, 2]


@pytest.mark.parametrize(("count", "threads", "own"), [(1, 3, True), (4, 0, True), (2, 1, False), (4, 3, False)])
def test_a_single_piece_and_pieces_without_threads_run_in_the_callers_thread(
    count: int, threads: int, own: bool
) -> None:
    found = set(in_order([threading.get_ident] * count, threads))
    assert found == {threading.get_ident()} if own else threading.get_ident() not in found
    assert len(found) <= max(threads, 1)


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_work_is_taken_as_results_are(threads: int) -> None:
    taken: list[int] = []

    def work() -> Iterator[Callable[[], int]]:
        for number in range(50):
            taken.append(number)
            yield partial(int, number)

    results = in_order(work(), threads)
    assert taken == []
    for number, result in enumerate(results, 1):
        assert result == number - 1
        # Two are always taken, to know whether there is only one.
        assert len(taken) <= max(2, number + threads)
    assert len(taken) == 50


def test_what_has_not_begun_is_not_done_after_closing() -> None:
    done: list[int] = []
    first_begun, go_on = threading.Event(), threading.Event()

    def piece(number: int) -> int:
        if number == 1:
            first_begun.set()
            go_on.wait(PATIENCE)
        done.append(number)
        return number

    with closing(in_order((partial(piece, number) for number in range(50)), 1)) as results:
        assert next(results) == 0
        assert first_begun.wait(PATIENCE)
        threading.Timer(0.05, go_on.set).start()
    # The second was under way.
    assert done == [0, 1]
    assert list(results) == []


@pytest.mark.parametrize("threads", [0, 2])
def test_an_error_comes_in_its_turn_and_ends_the_work(threads: int) -> None:
    work: list[Callable[[], int]] = [lambda: 1, lambda: 1 // 0, lambda: 3]
    results = in_order(work, threads)
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert list(results) == []


def test_threads_keep_the_cores_busy_and_a_single_picture_needs_none() -> None:
    assert reading_threads(0) == reading_threads(1) == 0
    assert reading_threads(2) == reading_threads(1000) == min(8, cores()) + 1
    before = cores()
    with at_most_cores(1):
        assert cores() == 1
        assert reading_threads(2) == 2
    with at_most_cores(10_000):
        assert cores() == before
    assert cores() == before
