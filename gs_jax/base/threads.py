"""Host code on several cores: NumPy computes on arrays without holding Python's lock."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# More would wait for memory, and each holds what it works on.
_MOST = 8


def in_threads(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """What `work` makes of each of the items, in their order, as it becomes ready; a thread for each core does so."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _MOST)) as threads:
        yield from threads.map(work, items)
