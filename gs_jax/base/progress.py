"""Progress bars on a terminal; nothing in a pipe."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress as Bars, TextColumn, TimeElapsedColumn


class Progress:
    """Bars that show how far long work is, on standard error where that is a terminal.

    A context; with `shown=False` it shows nothing.
    """

    def __init__(self, *, shown: bool = True):
        console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
        self._bars = Bars(*columns, console=console) if shown and console.is_terminal else None

    def __enter__(self) -> "Progress":
        if self._bars:
            self._bars.start()
        return self

    def __exit__(self, *_) -> None:
        if self._bars:
            self._bars.stop()

    def track(self, items: Iterable, description: str) -> Iterable:
        """The items, one by one, with a bar."""
        return self._bars.track(items, description=description) if self._bars else items

    @contextmanager
    def step(self, description: str) -> Iterator[None]:
        """Work of unknown length."""
        if not self._bars:
            yield
            return
        task = self._bars.add_task(description, total=None)
        yield
        self._bars.update(task, total=1, completed=1)

    @contextmanager
    def counter(self, description: str, total: int) -> Iterator[Callable[[], None]]:
        """Work of `total` parts; what it yields is called after each."""
        if not self._bars:
            yield lambda: None
            return
        bars, task = self._bars, self._bars.add_task(description, total=total)
        yield lambda: bars.advance(task)


# What functions show that are given no progress.
SILENT = Progress(shown=False)
