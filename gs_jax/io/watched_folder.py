"""The captures that a camera's program writes into a folder, as they come."""

import os
import queue
import threading
from pathlib import Path

from ..base.errors import InputError, needs_extra
from .captures import CAPTURE_SUFFIXES
from .recordings import natural_key

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
        try:
            while True:
                found = self._changes.get(timeout=timeout) if not names and timeout else self._changes.get_nowait()
                if isinstance(found, Exception):
                    raise found
                names += found
        except queue.Empty:
            return sorted(dict.fromkeys(names), key=natural_key)

    def _run(self) -> None:
        how = {"step": _STEP, "debounce": _GATHER, "rust_timeout": _LISTED, "yield_on_timeout": True}
        listed = True
        try:
            self._tell(os.listdir(self.folder), listed)
            for changes in self._watch(
                self.folder, watch_filter=None, stop_event=self._stop, recursive=False, raise_interrupt=False, **how
            ):
                # What came before the library began to watch is in the list.
                listed = listed or not changes
                if listed:
                    self._tell(os.listdir(self.folder), listed)
                self._tell([os.path.basename(path) for _, path in changes], listed=False)
                listed = False
        except OSError as error:
            self._changes.put(InputError(f"{self.folder}: cannot be watched any more: {error.strerror or error}."))

    def _tell(self, names: list[str], listed: bool) -> None:
        captures = [name for name in names if name.lower().endswith(CAPTURE_SUFFIXES) and not name.startswith(".")]
        captures = [name for name in captures if name not in self._told] if listed else captures
        # The library also tells of files that are deleted.
        captures = [name for name in captures if (self.folder / name).is_file()]
        self._told.update(captures)
        if captures:
            self._changes.put(captures)
