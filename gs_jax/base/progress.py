"""Progress reports: bars on a terminal, lines in a pipe, or a state that another thread reads."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import partial
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress as Bars,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from .machine import peak_memory

# Seconds between two lines; work that takes longer than `_LONG` is announced, once parts took `_MEASURED` seconds.
_EVERY, _LONG, _MEASURED = 10.0, 60.0, 3.0
# QUIET shows nothing, VERBOSE a line after every task.
QUIET, NORMAL, VERBOSE = -1, 0, 1
verbosity: ContextVar[int] = ContextVar("verbosity", default=NORMAL)


class Progress:
    """Progress on standard error: bars on a terminal, otherwise a line every ten seconds.

    *Host.*

    It reports only inside its `with` block, as much as `verbosity` says.

    Examples
    --------
    >>> with gs.Progress() as progress:  # prints to standard error while work takes long
    ...     for _ in progress.track(range(3), "Counting"):
    ...         pass
    """

    _bars: Bars | None = None
    _lines = False

    def __enter__(self) -> "Progress":
        console, level = Console(stderr=True), verbosity.get()
        if console.is_terminal and level == NORMAL:
            counts = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
            times = TimeElapsedColumn(), TextColumn("left:"), TimeRemainingColumn()
            self._bars = Bars(*counts, *times, TextColumn("{task.fields[rate]}"), console=console)
            self._bars.start()
        self._lines = level == VERBOSE or (level == NORMAL and not console.is_terminal)
        return self

    def __exit__(self, *_) -> None:
        if self._bars:
            self._bars.stop()
        self._lines = False

    def track(self, items: Iterable, description: str, *, quarter: str = "") -> Iterator:
        """Iterate over items and count them."""
        with self.counter(description, len(items) if isinstance(items, Sized) else None, quarter=quarter) as advance:
            for item in items:
                yield item
                advance()

    @contextmanager
    def step(self, description: str) -> Iterator[None]:
        """Report a task of unknown length."""
        with self.counter(description, None) as advance:
            yield
            advance()

    def counter(
        self,
        description: str,
        total: int | None,
        *,
        quarter: str = "",
        rate: str = "",
        words: Callable[[], str] | None = None,
    ) -> AbstractContextManager[Callable[[], None]]:
        """Report a task of `total` parts, if known; call the value of the `with` statement after each part.

        A task of more than a minute is announced, with its time and memory, and the option `quarter` that would take a
        quarter of the time. `rate` is the plural of the parts, if their number per second is shown, and `words` tells
        what else is shown beside it.
        """
        task = _Task(description, total, quarter)
        if self._bars:
            return _bar(self._bars, task, rate, words)
        return _lines(task, rate, words) if self._lines else nullcontext(lambda: None)


class _Task:
    """Counts the parts of a task, and estimates its time.

    The first part compiles, and the longest of the others may have waited for output: the estimate leaves out both.
    """

    def __init__(self, description: str, total: int | None, quarter: str = ""):
        self.description, self.total, self.quarter = description, total, quarter
        self.done, self.first, self.last, self.longest, self.announced = 0, 0.0, 0.0, 0.0, False

    def advance(self, now: float) -> None:
        self.done += 1
        if self.done == 1:
            self.first = now
        else:
            self.longest = max(self.longest, now - self.last)
        self.last = now

    @property
    def seconds_each(self) -> float:
        """Seconds of a part; needs two parts."""
        left_out = self.done > 2
        return (self.last - self.first - left_out * self.longest) / (self.done - 1 - left_out)

    def announcement(self) -> str | None:
        """Time and memory of a long task, once, as soon as they can be estimated."""
        if self.total is None or self.announced or self.done < 2 or self.last - self.first < _MEASURED:
            return None
        self.announced = True
        if (seconds := self.seconds_each * self.total) <= _LONG:
            return None
        memory = f"{peak_memory() / 2**30:.2g} GiB of memory"  # further parts take no more
        quarter = f"; {self.quarter}: about {_format_seconds(seconds / 4)}" if self.quarter else ""
        return f"gs-jax: {self.description}: about {_format_seconds(seconds)} in all, {memory}{quarter}"


def _format_seconds(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 1.5 * _LONG else f"{seconds:.0f} s"


@contextmanager
def _bar(bars: Bars, task: _Task, rate: str, words: Callable[[], str] | None) -> Iterator[Callable[[], None]]:
    bar, began = bars.add_task(task.description, total=task.total, rate=""), time.monotonic()

    def advance():
        bars.advance(bar)
        task.advance(now := time.monotonic())
        if text := task.announcement():
            bars.console.print(text, highlight=False, soft_wrap=True)
        if rate and now > began:
            more = f", {words()}" if words else ""
            bars.update(bar, rate=f"{task.done / (now - began):.3g} {rate}/s{more}")

    yield advance
    if task.total is None:
        bars.update(bar, total=bars.tasks[bar].completed)


@contextmanager
def _lines(task: _Task, rate: str, words: Callable[[], str] | None) -> Iterator[Callable[[], None]]:
    say = partial(print, file=sys.stderr, flush=True)
    began = last = time.monotonic()

    def say_state(now: float):
        nonlocal last
        last, taken, done = now, now - began, task.done
        left = (task.total or done) - done
        seconds = task.seconds_each if done > 1 else taken
        of, digits = f" of {task.total}" if task.total else "", 0 if taken >= _EVERY else 2
        per_second = f", {done / taken:.3g} {rate}/s" if rate and taken > 0 else ""
        time_left = f", about {seconds * left:.0f} s left" if left and done else ""
        more = f", {words()}" if words else ""
        say(f"gs-jax: {task.description}: {done}{of}, {taken:.{digits}f} s{per_second}{more}{time_left}")

    def advance():
        task.advance(now := time.monotonic())
        if text := task.announcement():
            say(text)
        if now - last >= _EVERY:
            say_state(now)

    yield advance
    if verbosity.get() == VERBOSE:
        say_state(time.monotonic())


class Cancelled(Exception):
    """Work that was cancelled between two of its parts."""


class CancellableProgress(Progress):
    """Progress that another thread reads by `state`; raises `Cancelled` at the next part once `cancelled()` is true."""

    def __init__(self, cancelled: Callable[[], bool]):
        self._cancelled = cancelled
        self._tasks: list[_Task] = []

    @contextmanager
    def counter(self, description: str, total: int | None, **shown: Any) -> Iterator[Callable[[], None]]:
        """As `Progress.counter`; of nested tasks, `state` tells the innermost."""
        self.check_cancelled()
        task = _Task(description, total)

        def advance():
            task.advance(time.monotonic())
            self.check_cancelled()

        self._tasks.append(task)
        try:
            yield advance
        finally:
            self._tasks.remove(task)

    def check_cancelled(self) -> None:
        if self._cancelled():
            raise Cancelled

    @property
    def state(self) -> tuple[str, int, int | None]:
        """Description of the task, its finished parts, and their total if it is known."""
        if not self._tasks:
            return "", 0, None
        task = self._tasks[-1]
        if not task.total:
            return task.description, task.done, task.total
        left = task.seconds_each * (task.total - task.done) if task.done > 1 else 0.0
        time_left = f", about {_format_seconds(left)} left" if left else ""
        return f"{task.description}: {task.done} of {task.total}{time_left}", task.done, task.total
