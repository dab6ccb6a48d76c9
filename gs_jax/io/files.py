"""Reading files whole, and writing them whole or not at all: text, JSON, figures, and what other modules write."""

import contextlib
import ctypes
import errno
import json
import logging
import math
import os
import shutil
import stat
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any

from ..base.errors import InputError, MissingExtraError, input_error, short_repr
from .remote import PathLike as PathLike, remote_url

TIFF_SUFFIXES = (".tif", ".tiff")
MAX_TEXT_BYTES = 2**26
# Attempts to remove a folder, and the seconds between them.
_ATTEMPTS, _PAUSE = 30, 0.05
_WRITABLE = stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH
# Files that are being written.
_TEMPORARY: set[Path] = set()
# Metadata of a Zarr image, and the journal of `VolumeSeries`. A store with anything else in its root (labels, a plate,
# notes) may hold somebody's work and is not replaced. What tiles share is there until all are written.
_ZARR_METADATA, JOURNAL = {".zgroup", ".zarray", ".zattrs", ".zmetadata", "zarr.json"}, "frames.jsonl"
TILES = "tiles.npz"


# What to do about files of other suffixes.
_JPEG = "JPEG is lossy, and its values are not linear in light: save captures as TIFF or PNG"
_HINTS = {
    ".jpg": _JPEG,
    ".jpeg": _JPEG,
    ".mat": "convert it: numpy.save('a.npy', scipy.io.loadmat('a.mat')['NAME'].astype('float32')) (v7.3: h5py)",
}


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


def check_input(path: PathLike) -> Path:
    """Return the path of a regular file; `InputError` if it is missing, of another kind, or cannot be opened."""
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            with open(path, "rb"):
                return Path(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {_reason(error)}.") from error
    raise input_error("input", "a file", "a folder" if stat.S_ISDIR(mode) else "a device or a pipe", path)


def read_text(path: PathLike, most: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 file of at most `most` bytes, without its byte order mark.

    Raises `InputError` if it cannot be read, is too large or is not UTF-8.
    """
    path = check_input(path)
    if path.stat().st_size > most:
        raise input_error("file", f"at most {most} bytes", path.stat().st_size, path)
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise input_error("text", "UTF-8", f"another byte at offset {error.start}", path) from error


def check_suffix(path: PathLike, suffixes: Sequence[str]) -> str:
    """Return the suffix of a path in lower case; `InputError` if it is none of these."""
    suffix = Path(path).suffix
    if suffix.lower() not in suffixes:
        hint = f"; {_HINTS[suffix.lower()]}" if suffix.lower() in _HINTS and TIFF_SUFFIXES[0] in suffixes else ""
        raise input_error("suffix", ", ".join(suffixes), f"{short_repr(suffix)}{hint}", path)
    return suffix.lower()


def check_output(path: PathLike, suffixes: Sequence[str]) -> Path:
    """Return a path that can be written; for calls before a long computation.

    Raises `InputError` if the suffix is none of `suffixes`, the folder is missing or not writable, the path or the
    provenance beside it is write-protected, or the path is a device or a folder, other than a Zarr image that `.zarr`
    would replace.
    """
    check_suffix(path, suffixes)
    _check_target(Path(path))
    _check_protection(Path(f"{path}.json"))
    return Path(path)


def side_file(path: PathLike, suffix: str) -> Path:
    """The path of a file that is written beside an output, such as `new.toml.json`: those of two outputs differ."""
    return Path(f"{os.fspath(path)}{suffix}")


def checkpoint_path(output: Path, *, resume: bool = False) -> Path:
    """Path of the checkpoint beside an output file; to `resume` the one of an older version, if there is no other."""
    path, older = side_file(output, ".checkpoint"), output.with_suffix(".checkpoint")
    return older if resume and older.exists() and not path.exists() else path


def make_folder(path: PathLike) -> Path:
    """Make a folder and its parents if they are missing; `InputError` if it cannot be made or written to."""
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
            mode = os.stat(path).st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be written: {_reason(error)}.") from error
    _check_protection(path)
    is_zarr = path.suffix.lower() == ".zarr"
    if stat.S_ISDIR(mode) and not (is_zarr and _is_only_an_image(path)):
        raise InputError(f"{path}: cannot be written: a folder is replaced only if it is a Zarr image.")
    if not stat.S_ISDIR(mode) and (is_zarr or not stat.S_ISREG(mode)):
        raise InputError(f"{path}: cannot be written: a file or device of another kind has this name.")


def _check_protection(path: Path) -> None:
    """Raise `InputError` if a file or folder is write-protected: for a rename, that of its folder alone would count."""
    with contextlib.suppress(OSError):
        # Also where the system lets the superuser write.
        if not os.stat(path).st_mode & _WRITABLE or not os.access(path, os.W_OK):
            advice = "choose another name, or allow it by chmod u+w; --force does not"
            raise InputError(f"{path}: cannot be written: it is write-protected; {advice}.")


def _is_only_an_image(folder: Path) -> bool:
    names = set(os.listdir(folder)) - {JOURNAL, TILES}
    return bool(names & _ZARR_METADATA) and all(name in _ZARR_METADATA or name.isdecimal() for name in names)


@contextlib.contextmanager
def atomic_write(path: PathLike) -> Iterator[Path]:
    """Give a temporary path for a file or a Zarr folder, which replaces `path` at the end of the `with` block.

    After any exception the new file is removed and the old one is unchanged. A link stays a link: its target is
    replaced.

    Raises `InputError` as `check_output`, before anything is written; `OSError` if it cannot be written whole: with a
    number and the name of `path`.
    """
    target = Path(os.path.realpath(path))
    _check_target(target)
    temporary = _temporary_beside(target)
    _TEMPORARY.add(temporary)
    try:
        with disk_errors_name(path, temporary):
            yield temporary
            if not temporary.is_dir():
                with open(temporary, "r+b") as file:
                    os.fsync(file.fileno())
            _keep_mode(target, temporary)
            _replace(temporary, target)
    finally:
        _remove(temporary)
        _TEMPORARY.discard(temporary)


@contextlib.contextmanager
def disk_errors_name(path: PathLike, written: Path) -> Iterator[None]:
    """Make each `OSError` that comes from writing to `written` have a number and the name of `path`.

    Errors of a full disk name no file or a temporary one; those of NumPy and tifffile have no number either.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and not str(error.filename or written).startswith(str(written)):
            raise
        reason = error.strerror or f"cannot be written: {error}"
        raise OSError(error.errno or errno.ENOSPC, reason, str(path)) from error


def remove_temporaries() -> None:
    """Remove what `atomic_write` has not finished, when the process is about to exit without unwinding."""
    for temporary in list(_TEMPORARY):
        _remove(temporary)


def _temporary_beside(path: PurePath) -> Any:
    # Not by `tempfile`, whose files only their owner can read: the user's umask decides that.
    return path.with_name(f".gs-jax-{uuid.uuid4().hex[:12]}{path.suffix}")


def _keep_mode(old: Path, new: Path) -> None:
    """Give a file, or a folder, the permissions of the one that it replaces."""
    with contextlib.suppress(FileNotFoundError):
        os.chmod(new, stat.S_IMODE(os.stat(old).st_mode))


def _replace(temporary: Path, path: Path) -> None:
    if not path.is_dir():
        os.replace(temporary, path)
        return
    if _exchange(temporary, path):  # the old folder is now the temporary one, which the caller removes
        return
    old = _temporary_beside(path)
    os.rename(path, old)
    try:
        os.rename(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):  # a folder that another process made of this name stays, and the old one
            os.rename(old, path)
        raise
    _remove(old)


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two folders at once, so that readers always find one; False where the system cannot."""
    names, swap = (os.fsencode(first), os.fsencode(second)), 2
    here = -100  # AT_FDCWD: names count from the working directory
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "renameat2"):
        return library.renameat2(here, names[0], here, names[1], swap) == 0
    if sys.platform == "darwin" and hasattr(library := ctypes.CDLL(None), "renamex_np"):
        return library.renamex_np(*names, swap) == 0
    return False


def _remove(path: Path) -> None:
    # Zarr's threads continue to write for a moment after an interrupt; the folder may be made only then.
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
def decoding(path: PathLike, kind: str) -> Iterator[None]:
    """Turn every exception of a third-party decoder into an `InputError`, and drop its warnings and log lines."""
    logger = logging.getLogger("tifffile")
    was_disabled, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (MemoryError, MissingExtraError):
        raise
    except Exception as error:
        # At an address it may be the network.
        fault = "cannot be read" if remote_url(path) else f"not a whole and valid {kind}"
        raise InputError(f"{path}: {fault}: {_reason(error).rstrip('.!'):.200}.") from error
    finally:
        logger.disabled = was_disabled


def write_json(path: PathLike, data: Any) -> None:
    """Write `data` as JSON; `InputError` as `check_output`.

    NumPy and JAX values become numbers and lists. JSON has no NaN and no infinity: both become null.
    """
    text = json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n", [".json"])


def write_text(path: PathLike, text: str, suffixes: Sequence[str]) -> None:
    """Write UTF-8 text, with names that are not UTF-8 as escapes; `InputError` as `check_output`."""
    with atomic_write(check_output(path, suffixes)) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n", errors="backslashreplace")


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if hasattr(data, "tolist"):
        return _plain(data.tolist())
    return None if isinstance(data, float) and not math.isfinite(data) else data


def write_figure(path: PathLike, figure: Any) -> None:
    """Write a matplotlib figure as PNG at its own resolution; `InputError` as `check_output`."""
    with atomic_write(check_output(path, [".png"])) as temporary:
        figure.savefig(temporary, format="png")
