"""Tells of captures as a camera's program writes them into a folder."""

import contextlib
import os
import queue
import threading
from pathlib import Path

from ..base.errors import InputError, needs_extra
from .names import natural_order
from .recordings import is_capture

# Milliseconds: between two looks of the watching library, and the longest time for which it gathers changes.
_STEP, _GATHER = 4, 8
# Milliseconds without a change after which the folder is listed, in case that a change was lost.
_LISTED = 2000


class WatchedFolder:
    """Context manager that tells which captures of a folder are new or were written to.

    Parameters
    ----------
    folder
        Its captures, not those of folders in it. Names that begin with a dot are left out, so that a program may write
        a file under such a name and rename it.

    Raises
    ------
    InputError
        If it is no folder, or `watchfiles` is not installed.
    """

    def __init__(self, folder: Path):
        if not folder.is_dir():
            raise InputError(f"{folder} must be a folder to be watched, got {'a file' if folder.exists() else 'none'}.")
        with needs_extra("live"):
            import watchfiles
        self.folder, self._watch = folder, watchfiles.watch
        self._changes: queue.SimpleQueue[list[str] | Exception] = queue.SimpleQueue()
        self._told: set[str] = set()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "WatchedFolder":
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._stop.set()
        self._thread.join()

    def changes(self, timeout: float) -> list[str]:
        """Names of captures that are new or have changed since the last call, in natural order.

        If there are none, waits for the first for so many seconds. Names may be told twice.
        """
        names: list[str] = []
        with contextlib.suppress(queue.Empty):
            while True:
                changed = self._changes.get(block=not names and timeout > 0, timeout=timeout or None)
                if isinstance(changed, Exception):
                    raise changed
                names += changed
        return natural_order(dict.fromkeys(names))

    def _run(self) -> None:
        options = {"step": _STEP, "debounce": _GATHER, "rust_timeout": _LISTED, "yield_on_timeout": True}
        options |= {"watch_filter": None, "stop_event": self._stop, "recursive": False, "raise_interrupt": False}
        listed = True
        try:
            self._tell(os.listdir(self.folder), listed)
            for changes in self._watch(self.folder, **options):
                # What came before the library began to watch is in the list.
                if listed or not changes:
                    self._tell(os.listdir(self.folder), True)
                self._tell([os.path.basename(path) for _, path in changes], False)
                listed = False
        except OSError as error:
            self._changes.put(InputError(f"{self.folder}: cannot be watched any more: {error.strerror or error}."))

    def _tell(self, names: list[str], listed: bool) -> None:
        captures = [name for name in names if is_capture(name) and not (listed and name in self._told)]
        # The library also tells of files that are deleted.
        captures = [name for name in captures if (self.folder / name).is_file()]
        self._told.update(captures)
        if captures:
            self._changes.put(captures)
