"""Work in threads: in order, as it becomes ready, and its errors are the caller's."""

import threading

import pytest

from gs_jax.base.workers import map_in_threads


def test_results_are_in_the_order_of_the_items():
    first_may_end = threading.Event()

    def work(item):
        # Of two threads at least, the second ends first; a single one must not wait for itself.
        if item == 0:
            first_may_end.wait(0.2)
        first_may_end.set()
        return item**2

    assert list(map_in_threads(work, range(20))) == [item**2 for item in range(20)]


def test_nothing_to_do():
    assert not list(map_in_threads(str, []))


def test_an_error_is_passed_on():
    with pytest.raises(ZeroDivisionError):
        list(map_in_threads(lambda item: 1 / item, [1, 0, 2]))
