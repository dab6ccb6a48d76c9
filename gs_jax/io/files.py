"""How a file is read whole, or written whole or not at all; text, tables of numbers, and JSON."""

import contextlib
import errno
import json
import logging
import math
import os
import shutil
import stat
import tempfile
import time
import uuid
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, TypeVar

from ..base.errors import InputError, short_repr

# Not from `gs_jax.typing`, which imports JAX: the help of commands does without.
PathLike = str | os.PathLike[str]
AnyPath = TypeVar("AnyPath", bound=PurePath)

MAX_TEXT_BYTES = 2**26
# To remove a folder, and the seconds between them.
_ATTEMPTS, _PAUSE = 30, 0.05
# What is being written.
_TEMPORARY: set[Path] = set()

# What the root of an image in Zarr may hold. A store with anything else in it (labels, a plate, notes) is
# somebody's work and is not replaced.
_ZARR_METADATA = {".zgroup", ".zarray", ".zattrs", ".zmetadata", "zarr.json"}
# What we add to volumes in time: `volume_series`.
_OURS = {"frames.jsonl"}


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


def check_input(path: PathLike) -> Path:
    """The path of a regular file that can be opened for reading.

    Raises
    ------
    InputError
        If it is missing, a folder or a device, or may not be read.
    """
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            with open(path, "rb"):
                return Path(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the file cannot be read: {_reason(error)}.") from error
    found = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
    raise InputError(f"{path}: found {found}, allowed: a file.")


def read_text(path: PathLike, most: int = MAX_TEXT_BYTES) -> str:
    """The text of a UTF-8 file of at most `most` bytes, by default 64 MiB, without a byte order mark.

    Raises
    ------
    InputError
        If it cannot be read, is too large or is not UTF-8.
    """
    path = check_input(path)
    if path.stat().st_size > most:
        raise InputError(f"{path}: found {path.stat().st_size} bytes, allowed: at most {most}.")
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: found a byte that is not UTF-8 at offset {error.start}, allowed: UTF-8.") from error


def check_output(path: PathLike, suffixes: Sequence[str]) -> Path:
    """A path that can be written, with one of the `suffixes`; to be asked before a long computation.

    Raises
    ------
    InputError
        If the suffix is none of them, the folder is missing or not writable, or the path is taken by a folder
        (other than an image in Zarr where that is what will be written) or a device.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: found the suffix {short_repr(path.suffix)}, allowed: {', '.join(suffixes)}.")
    _check_target(path)
    return path


def make_folder(path: PathLike) -> Path:
    """A folder to write several files to, made with its parents where it is missing.

    Raises
    ------
    InputError
        If it cannot be made, is no folder, or cannot be written to.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be made a folder to write to: {_reason(error)}.") from error
    return path


def _check_target(path: Path) -> None:
    if not os.path.isdir(path.parent):
        raise InputError(f"{path}: cannot be written: there is no folder {path.parent}.")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            taken = os.stat(path).st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written: {_reason(error)}.") from error
    is_zarr = path.suffix.lower() == ".zarr"
    if stat.S_ISDIR(taken) and not (is_zarr and _holds_only_an_image(path)):
        raise InputError(f"{path}: cannot be written: found a folder, which is not replaced unless it is a Zarr image.")
    if not stat.S_ISDIR(taken) and (is_zarr or not stat.S_ISREG(taken)):
        raise InputError(f"{path}: cannot be written: found a file or device of another kind in its place.")


def _holds_only_an_image(folder: Path) -> bool:
    names = set(os.listdir(folder))
    return bool(names & _ZARR_METADATA) and all(name in _ZARR_METADATA | _OURS or name.isdecimal() for name in names)


@contextlib.contextmanager
def atomic_write(path: PathLike) -> Iterator[Path]:
    """A path beside `path` to write a file or a Zarr folder to, which takes its place at the end.

    Whatever goes wrong inside, an interrupt too, the new file is removed and the old one is as it was.
    A link stays a link: what it points to is replaced.

    Raises
    ------
    InputError
        As `check_output`, before anything is written.
    OSError
        If it cannot be written whole: with a number and the name of `path`.
    """
    target = Path(os.path.realpath(path))
    _check_target(target)
    temporary = _temporary_beside(target)
    _TEMPORARY.add(temporary)
    try:
        yield temporary
        if not temporary.is_dir():
            with open(temporary, "r+b") as file:
                os.fsync(file.fileno())
        _replace(temporary, target)
    except OSError as error:
        # Errors of a full disk name no file or the temporary one; NumPy's and tifffile's have no number either.
        if error.errno is not None and not str(error.filename or temporary).startswith(str(temporary)):
            raise
        reason = error.strerror or f"cannot be written: {error}"
        raise OSError(error.errno or errno.ENOSPC, reason, str(path)) from error
    finally:
        _remove(temporary)
        _TEMPORARY.discard(temporary)


def remove_temporaries() -> None:
    """Removes what `atomic_write` has not finished, when the process ends without its own cleaning up."""
    for temporary in list(_TEMPORARY):
        _remove(temporary)


def _temporary_beside(path: AnyPath) -> AnyPath:
    # Not `tempfile`, whose files nobody else may read: the user's umask is to decide that.
    return path.with_name(f".gs-jax-{uuid.uuid4().hex[:12]}{path.suffix}")


def _replace(temporary: Path, path: Path) -> None:
    if not path.is_dir():
        os.replace(temporary, path)
        return
    old = _temporary_beside(path)
    os.rename(path, old)
    try:
        os.rename(temporary, path)
    except BaseException:
        os.rename(old, path)
        raise
    _remove(old)


def _remove(path: Path) -> None:
    # Zarr's own threads go on writing for a moment after an interrupt; the folder may be made only then.
    for _ in range(_ATTEMPTS):
        if not path.is_dir():
            with contextlib.suppress(IsADirectoryError):
                path.unlink(missing_ok=True)
                return
        shutil.rmtree(path, ignore_errors=True)
        time.sleep(_PAUSE)
        if not path.exists():
            return


@contextlib.contextmanager
def decoding(path: Path, kind: str) -> Iterator[None]:
    """Around a call of a third-party decoder, and nothing else: whatever it raises is the file's fault.

    Its warnings and log lines are dropped: a file is read, or refused in one line.
    """
    logger = logging.getLogger("tifffile")
    was_disabled, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except MemoryError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not a whole and valid {kind}: {_reason(error).rstrip('.!'):.200}.") from error
    finally:
        logger.disabled = was_disabled


def write_json(path: PathLike, data: Any) -> None:
    """Writes `data` as JSON, whole or not at all.

    NumPy and JAX values become numbers and lists. JSON has no NaN and no infinity: both become null.

    Raises
    ------
    InputError
        As `check_output`, for `.json`.
    """
    text = json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n", [".json"])


def write_text(path: PathLike, text: str, suffixes: Sequence[str]) -> None:
    """Writes UTF-8 text, whole or not at all; `InputError` as `check_output`."""
    with atomic_write(check_output(path, suffixes)) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if hasattr(data, "tolist"):
        return _plain(data.tolist())
    return None if isinstance(data, float) and not math.isfinite(data) else data


def write_figure(path: PathLike, figure: Any) -> None:
    """Writes a figure as PNG at its own resolution, whole or not at all; `InputError` as `check_output`."""
    with atomic_write(check_output(path, [".png"])) as temporary:
        figure.savefig(temporary, format="png")
