"""How far long work is, and how long it will take: bars on a terminal, a line now and then in a pipe."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress as Bars,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from .machine import most_memory

# Seconds between two lines; what takes longer than a minute is announced.
_EVERY, _LONG = 10.0, 60.0
# Seconds of parts after the first that tell how long the others take.
_TELLING = 3.0
# How much is shown: QUIET is nothing, VERBOSE a line after every piece of work.
QUIET, NORMAL, VERBOSE = -1, 0, 1
shown: ContextVar[int] = ContextVar("shown", default=NORMAL)


class Progress:
    """How far long work is, on standard error: bars on a terminal, else a line every ten seconds.

    As much as `shown` says, within `with Progress() as progress:`; one that is not entered shows nothing.

    Examples
    --------
    >>> import gs_jax as gs
    >>> with gs.Progress() as progress:  # prints to standard error while work takes long
    ...     for _ in progress.track(range(3), "Counting"):
    ...         pass
    """

    _bars: Bars | None = None
    _lines = False

    def __enter__(self) -> "Progress":
        console, level = Console(stderr=True), shown.get()
        if console.is_terminal and level == NORMAL:
            times = TimeElapsedColumn(), TextColumn("left:"), TimeRemainingColumn()
            self._bars = Bars(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                *times,
                TextColumn("{task.fields[rate]}"),
                console=console,
            )
            self._bars.start()
        self._lines = level == VERBOSE or (level == NORMAL and not console.is_terminal)
        return self

    def __exit__(self, *_) -> None:
        if self._bars:
            self._bars.stop()
        self._lines = False

    def track(self, items: Iterable, description: str, *, quarter: str = "") -> Iterator:
        """The items, one by one, as the parts of a counter."""
        with self.counter(description, len(items) if isinstance(items, Sized) else None, quarter=quarter) as done:
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
    def counter(
        self, description: str, total: int | None, *, quarter: str = "", rate: str = ""
    ) -> Iterator[Callable[[], None]]:
        """Work of `total` parts; what it yields is called after each.

        `quarter`: what would take a fourth of the time. `rate`: what the parts are, if so many a second are shown.
        Soon after the second part, work of more than a minute is announced: its time, the memory, and the quarter.
        """
        if bars := self._bars:
            task = bars.add_task(description, total=total, rate="")
            began = time.monotonic()
            forecast = _Forecast(
                description, total, partial(bars.console.print, highlight=False, soft_wrap=True), quarter
            )

            def advance():
                bars.advance(task)
                forecast(now := time.monotonic())
                if rate and now > began:
                    bars.update(task, rate=f"{forecast.done / (now - began):.3g} {rate}/s")

            yield advance
            if total is None:
                bars.update(task, total=bars.tasks[task].completed)
        elif self._lines:
            yield (lines := _Lines(description, total, quarter, rate))
            if shown.get() == VERBOSE:
                lines.say(time.monotonic())
        else:
            yield lambda: None


class _Forecast:
    """Called after each part; when what comes after the first tells, it says how long all will take.

    The first part compiles, and of the others the longest is left out: it may have waited for the first to be written.
    And how much memory: the most that was taken, as further parts take no more.
    """

    def __init__(self, description: str, total: int | None, say: Callable[[str], object], quarter: str):
        self.description, self.total, self.say, self.quarter = description, total, say, quarter
        self.done, self.first, self.last, self.longest, self.said = 0, 0.0, 0.0, 0.0, False

    def __call__(self, now: float) -> None:
        self.done += 1
        if self.done == 1:
            self.first = now
        else:
            self.longest = max(self.longest, now - self.last)
        self.last = now
        if self.total is None or self.said or self.done < 2 or now - self.first < _TELLING:
            return
        self.said = True
        if (whole := self.each * self.total) > _LONG:
            sooner = f"; {self.quarter}: about {_in_words(whole / 4)}" if self.quarter else ""
            memory = f"{most_memory() / 2**30:.2g} GiB of memory"
            self.say(f"gs-jax: {self.description}: about {_in_words(whole)} in all, {memory}{sooner}")

    @property
    def each(self) -> float:
        """Seconds of a part, once there are two."""
        left_out = self.done > 2
        return (self.last - self.first - left_out * self.longest) / (self.done - 1 - left_out)


def _in_words(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 1.5 * _LONG else f"{seconds:.0f} s"


class _Lines:
    """Called after each part, it prints a line where the last is old."""

    def __init__(self, description: str, total: int | None, quarter: str, rate: str = ""):
        self.description, self.total, self.rate, self.done = description, total, rate, 0
        self.began = self.last = time.monotonic()
        self.forecast = _Forecast(description, total, partial(print, file=sys.stderr, flush=True), quarter)

    def __call__(self) -> None:
        self.done += 1
        now = time.monotonic()
        self.forecast(now)
        if now - self.last >= _EVERY:
            self.say(now)

    def say(self, now: float) -> None:
        self.last = now
        taken, left = self.last - self.began, (self.total or self.done) - self.done
        each = self.forecast.each if self.done > 1 else taken
        time_left = f", about {each * left:.0f} s left" if left and self.done else ""
        of, digits = f" of {self.total}" if self.total else "", 0 if taken >= _EVERY else 2
        rate = f", {self.done / taken:.3g} {self.rate}/s" if self.rate and taken > 0 else ""
        line = f"gs-jax: {self.description}: {self.done}{of}, {taken:.{digits}f} s{rate}{time_left}"
        print(line, file=sys.stderr, flush=True)


class Ended(Exception):
    """Work was ended between two of its parts, as somebody asked for."""


class Watched(Progress):
    """How far work is, for another thread that shows it, and may end it.

    Parameters
    ----------
    ended
        Asked before each piece of work and after each part of it: if so, `Ended` is raised there.
    """

    def __init__(self, ended: Callable[[], bool]):
        self._ended = ended
        self._pieces: list[_Forecast] = []

    @contextmanager
    def counter(
        self, description: str, total: int | None, *, quarter: str = "", rate: str = ""
    ) -> Iterator[Callable[[], None]]:
        """As that of `Progress`; of pieces within each other the innermost is seen."""
        self.go_on()
        piece = _Forecast(description, total, lambda _: None, quarter)

        def advance():
            piece(time.monotonic())
            self.go_on()

        self._pieces.append(piece)
        try:
            yield advance
        finally:
            self._pieces.remove(piece)

    def go_on(self) -> None:
        """Raises `Ended` if it is to end."""
        if self._ended():
            raise Ended

    @property
    def now(self) -> tuple[str, int, int | None]:
        """What is being done, how many parts of it are, and of how many, if that is known."""
        piece = self._pieces[-1:]
        if not piece:
            return "", 0, None
        one = piece[0]
        left = one.each * (one.total - one.done) if one.total and one.done > 1 else 0.0
        words = f"{one.description}: {one.done} of {one.total}" if one.total else one.description
        return words + (f", about {_in_words(left)} left" if left else ""), one.done, one.total
