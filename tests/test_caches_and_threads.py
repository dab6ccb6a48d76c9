"""Results that are kept in memory and on disk; work in threads: in order, and its errors are the caller's."""

import os
import threading
from pathlib import Path

import numpy as np
import pytest

from gs_jax.base import caches
from gs_jax.base.caches import cache_by_value, cached_on_disk, key_of
from gs_jax.base.workers import map_in_threads


class Counted:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"a": np.arange(6.0).reshape(2, 3), "b": np.float32(0.1)}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "gs_jax"


def test_arrays_are_computed_once(folder):
    compute = Counted()
    first, second = (cached_on_disk([b"x", b"y"], compute) for _ in range(2))
    assert compute.calls == 1 and len(list(folder.iterdir())) == 1
    for name in ("a", "b"):
        assert first[name].dtype == second[name].dtype
        np.testing.assert_array_equal(first[name], second[name])
    cached_on_disk([b"xy"], compute)
    assert compute.calls == 2


def test_a_damaged_file_is_replaced(folder):
    compute = Counted()
    cached_on_disk([b"x"], compute)
    (file,) = folder.iterdir()
    for content in (b"", b"nonsense", file.read_bytes()[:300]):
        file.write_bytes(content)
        cached_on_disk([b"x"], compute)
    cached_on_disk([b"x"], compute)
    assert compute.calls == 4


def test_arrays_of_a_file_with_any_damaged_byte_are_right(folder):
    compute = Counted()
    right = cached_on_disk([b"x"], compute)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    directory = range(whole.index(b"PK\x01\x02"), len(whole))
    for place in (*range(0, directory.start, 9), *directory):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        read = cached_on_disk([b"x"], compute)
        assert read.keys() == right.keys() and all(np.array_equal(read[name], right[name]) for name in right)
    assert compute.calls > len(directory) / 2


def test_arrays_of_a_folder_that_cannot_be_written_are_read(monkeypatch):
    compute = Counted()
    cached_on_disk([b"x"], compute)

    def refuse(path):
        raise PermissionError(path)

    monkeypatch.setattr(os, "utime", refuse)
    cached_on_disk([b"x"], compute)
    assert compute.calls == 1


def test_keys_have_types_shapes_and_numbers():
    zeros = np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.int64), np.zeros(8, np.float32), np.ones(4), (np.zeros(4),)
    assert len({tuple(key_of(array)) for array in zeros}) == len(zeros)
    with pytest.raises(TypeError, match="array or a number"):
        key_of({"a": object()})


def test_nothing_is_kept_where_nothing_can_be_written(tmp_path, monkeypatch):
    compute = Counted()
    (tmp_path / "gs_jax").write_text("a file in place of the folder")
    assert cached_on_disk([b"x"], compute)["a"].shape == (2, 3)
    monkeypatch.delenv("XDG_CACHE_HOME")

    def no_home():
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", no_home)
    assert cached_on_disk([b"x"], compute)["a"].shape == (2, 3) and compute.calls == 2


def test_files_that_were_not_read_for_longest_are_removed(folder, monkeypatch):
    compute = Counted()
    cached_on_disk([b"x"], compute)
    size = next(folder.iterdir()).stat().st_size
    monkeypatch.setattr(caches, "_MOST_BYTES", 2.5 * size)
    cached_on_disk([b"y"], compute)
    for age, file in enumerate(folder.iterdir()):
        os.utime(file, (1e9 - age, 1e9 - age))
    cached_on_disk([b"x"], compute)
    cached_on_disk([b"z"], compute)
    assert len(list(folder.iterdir())) == 2 and compute.calls == 3
    cached_on_disk([b"x"], compute)
    assert compute.calls == 3


def test_results_are_kept_for_arguments_of_the_same_values():
    calls = []

    @cache_by_value(maxsize=2)
    def twice(tree, scale=2):
        calls.append(scale)
        return scale * tree["a"]

    first = twice({"a": np.arange(3.0)})
    assert twice({"a": np.arange(3.0)}) is first and len(calls) == 1
    np.testing.assert_array_equal(twice({"a": np.arange(3)}), [0, 2, 4])
    np.testing.assert_array_equal(twice({"a": np.arange(3.0)}, scale=3), [0, 3, 6])
    assert calls == [2, 2, 3] and twice({"a": np.arange(3.0)}) is not first


def test_results_of_threads_are_in_the_order_of_the_items():
    first_may_end = threading.Event()

    def work(item):
        # Of two threads at least, the second ends first; a single one must not wait for itself.
        if item == 0:
            first_may_end.wait(0.2)
        first_may_end.set()
        return item**2

    assert list(map_in_threads(work, range(20))) == [item**2 for item in range(20)] and not list(
        map_in_threads(str, [])
    )
    with pytest.raises(ZeroDivisionError):
        list(map_in_threads(lambda item: 1 / item, [1, 0, 2]))
