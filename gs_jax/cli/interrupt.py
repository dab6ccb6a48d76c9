"""Ctrl-C and SIGTERM end a command soon, whatever compiled code it is in, and leave nothing half-written."""

import multiprocessing
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..io.files import remove_temporaries

# Seconds that Python has to end by itself: to close files, and to say what it wants to say.
PATIENCE = 1.0
# Exit status of a command that a signal ended, as shells have it.
_BY_SIGNAL = 128
# Files to be named after an interrupt, and what to say of them.
kept: dict[Path, str] = {}
RESUMABLE, PARTIAL = "has what is done, and --resume goes on from it", "has what is done"


class Terminated(KeyboardInterrupt):
    """SIGTERM, as an exception like that of Ctrl-C."""


def status_of(interrupt: BaseException | None) -> int:
    """130 for Ctrl-C, 143 for SIGTERM."""
    return _BY_SIGNAL + (signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)


def message() -> str:
    """The line that an interrupted command ends with."""
    there = [f"{path} {text}" for path, text in kept.items() if path.exists()]
    return f"gs-jax: {'; '.join(['interrupted', *there])}"


@contextmanager
def ending_soon() -> Iterator[None]:
    """Within it, a signal raises an exception, as always, and if that has not ended the process soon, ends it.

    Compiled code returns to Python when it is done, minutes later at full scale; until then there is no exception.
    Only the main thread may call it.
    """
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    wakeup = signal.set_wakeup_fd(theirs.fileno())
    # A process in the background may ignore Ctrl-C, and goes on to.
    heard = {number: own for number, own in _HANDLERS.items() if signal.getsignal(number) != signal.SIG_IGN}
    handlers = {number: signal.signal(number, own) for number, own in heard.items()}
    hook, sys.unraisablehook = sys.unraisablehook, _unraisable
    threading.Thread(target=_watch, args=(ours,), daemon=True).start()
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        theirs.close()


def end(status: int) -> None:
    """Ends the process here and now. An interpreter that shuts down under running compiled code may crash."""
    remove_temporaries()
    for child in multiprocessing.active_children():
        child.terminate()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def _interrupt(number, frame):
    _end_while_importing(number, frame)
    raise KeyboardInterrupt


def _terminate(number, frame):
    _end_while_importing(number, frame)
    raise Terminated


_HANDLERS = {signal.SIGINT: _interrupt, signal.SIGTERM: _terminate}


def _end_while_importing(number, frame):
    """An exception within an extension's initialisation may crash it; nothing has been written that early."""
    while frame:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            print(message(), file=sys.stderr)
            end(_BY_SIGNAL + number)
        frame = frame.f_back


def _unraisable(found):
    """An interrupt within a garbage collector's callback goes no farther; the watch ends the process."""
    if not (found.exc_type and issubclass(found.exc_type, KeyboardInterrupt)):
        sys.__unraisablehook__(found)


def _watch(ours):
    with ours:
        while number := ours.recv(1):
            if number[0] in (signal.SIGINT, signal.SIGTERM):
                break
        else:
            return
    threading.Event().wait(PATIENCE)
    print(f"\n{message()}", file=sys.stderr)
    end(_BY_SIGNAL + number[0])
