"""Checkpoint of a search: its log as one line of JSON, then the solver's state as arrays."""

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx

from ..base.errors import InputError
from ..design.design import Design
from ..io.files import atomic_write, check_input, decoding
from ..typing import PathLike
from .solve import State
from .study import Study

_FORMAT = "gs-jax checkpoint 3"


@dataclass
class Log:
    """Record of a search.

    `steps`: one record a step, with the worst entry of each term. `ends`: one record for each finished start of a
    stage, with the reason for stopping, whether all targets are met, and the free parameters.
    """

    steps: list[dict[str, Any]] = field(default_factory=list)
    ends: list[dict[str, Any]] = field(default_factory=list)


def write_checkpoint(path: PathLike, log: Log, study: Study, design: Design, state: State | None) -> None:
    """Write a checkpoint atomically; the state is None between two starts."""
    head = {"format": _FORMAT, "of": _digest(study, design), "log": asdict(log)}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(json.dumps(head).encode() + b"\n")
        eqx.tree_serialise_leaves(file, state)


def read_checkpoint(path: PathLike, study: Study, design: Design) -> tuple[Log, bytes]:
    """Read the log, and the state for `restore_state`, empty between two starts.

    Raises
    ------
    InputError
        If the file cannot be read, is not a checkpoint, or belongs to another study or design.
    """
    head, _, state = check_input(path).read_bytes().partition(b"\n")
    try:
        found = json.loads(head)
        if found["format"] != _FORMAT:
            raise ValueError
        log, owner = Log(**found["log"]), found["of"]
        if not isinstance(log.steps, list) or not isinstance(log.ends, list):
            raise TypeError
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a checkpoint of `gs-jax optimize`.") from error
    if owner != _digest(study, design):
        raise InputError(f"{path}: the checkpoint is of another study or design.")
    return log, state


def restore_state(path: Path, state: bytes, like: State) -> State:
    """Restore the state of a checkpoint; `like` is a state of the same solver.

    Raises
    ------
    InputError
        If the file is truncated.
    """
    with decoding(path, "checkpoint"):
        return eqx.tree_deserialise_leaves(io.BytesIO(state), like)


def checkpoint_path(output: Path) -> Path:
    """Path of the checkpoint beside an output file."""
    return output.with_suffix(".checkpoint")


def _digest(study: Study, design: Design) -> str:
    return hashlib.sha256((study.model_dump_json() + design.model_dump_json()).encode()).hexdigest()
