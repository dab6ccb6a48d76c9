"""Progress bars on a terminal; nothing in a pipe."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress as Bars, TextColumn, TimeElapsedColumn


class Progress:
    """A context in which long work shows how far it is, on standard error."""

    def __init__(self):
        console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
        self._bars = Bars(*columns, console=console, disable=not console.is_terminal)

    def __enter__(self) -> "Progress":
        self._bars.start()
        return self

    def __exit__(self, *_) -> None:
        self._bars.stop()

    def track(self, items: Iterable, description: str) -> Iterable:
        """The items, one by one, with a bar."""
        return self._bars.track(items, description=description)

    @contextmanager
    def step(self, description: str) -> Iterator[None]:
        """Work of unknown length."""
        task = self._bars.add_task(description, total=None)
        yield
        self._bars.update(task, total=1, completed=1)

    @contextmanager
    def counter(self, description: str, total: int) -> Iterator[Callable[[], None]]:
        """Work of `total` parts; what it yields is called after each."""
        task = self._bars.add_task(description, total=total)
        yield lambda: self._bars.advance(task)
