"""Progress bars on a terminal; nothing in a pipe."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress as Bars, TextColumn, TimeElapsedColumn


class Progress:
    """Bars that show how far long work is, on standard error where that is a terminal.

    They are shown within `with Progress() as progress:`; one that is not entered shows nothing.
    """

    _bars: Bars | None = None

    def __enter__(self) -> "Progress":
        console = Console(stderr=True)
        if console.is_terminal:
            self._bars = Bars(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console)
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
        with self.counter(description, None) as done:
            yield
            done()

    @contextmanager
    def counter(self, description: str, total: int | None) -> Iterator[Callable[[], None]]:
        """Work of `total` parts; what it yields is called after each."""
        if not (bars := self._bars):
            yield lambda: None
            return
        task = bars.add_task(description, total=total)
        yield lambda: bars.update(task, total=total or 1, advance=1)
