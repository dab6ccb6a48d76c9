"""How far long work is, and how long it will take: bars on a terminal, a line now and then in a pipe."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress as Bars,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Seconds between two lines.
_EVERY = 10.0


class Progress:
    """How far long work is, on standard error: bars on a terminal, else a line every ten seconds.

    It is shown within `with Progress() as progress:`; one that is not entered shows nothing.
    """

    _bars: Bars | None = None
    _lines = False

    def __enter__(self) -> "Progress":
        console = Console(stderr=True)
        if console.is_terminal:
            times = TimeElapsedColumn(), TextColumn("left:"), TimeRemainingColumn()
            self._bars = Bars(
                TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), *times, console=console
            )
            self._bars.start()
        self._lines = not console.is_terminal
        return self

    def __exit__(self, *_) -> None:
        if self._bars:
            self._bars.stop()
        self._lines = False

    def track(self, items: Iterable, description: str) -> Iterator:
        """The items, one by one, as the parts of a counter."""
        with self.counter(description, len(items) if isinstance(items, Sized) else None) as done:
            for item in items:
                yield item
                done()

    @contextmanager
    def step(self, description: str) -> Iterator[None]:
        """Work of unknown length."""
        with self.counter(description, None) as done:
            yield
            done()

    @contextmanager
    def counter(self, description: str, total: int | None) -> Iterator[Callable[[], None]]:
        """Work of `total` parts; what it yields is called after each."""
        if bars := self._bars:
            task = bars.add_task(description, total=total)
            yield lambda: bars.advance(task)
            if total is None:
                bars.update(task, total=bars.tasks[task].completed)
        elif self._lines:
            yield _Lines(description, total)
        else:
            yield lambda: None


class _Lines:
    """Called after each part, it prints a line where the last is old."""

    def __init__(self, description: str, total: int | None):
        self.description, self.total, self.done = description, total, 0
        self.began = self.last = time.monotonic()

    def __call__(self) -> None:
        self.done += 1
        now = time.monotonic()
        if now - self.last < _EVERY:
            return
        self.last, taken = now, now - self.began
        left = "" if self.total is None else f", about {taken / self.done * (self.total - self.done):.0f} s left"
        of = "" if self.total is None else f" of {self.total}"
        print(f"gs-jax: {self.description}: {self.done}{of}, {taken:.0f} s{left}", file=sys.stderr, flush=True)
