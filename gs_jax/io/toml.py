"""Tables of TOML files as pydantic models, and their problems in one line."""

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, Discriminator, ValidationError

from ..base.errors import input_error, short_repr
from .files import PathLike, read_text

Place = tuple[int | str, ...]
# Tags of a union of one number and several; pydantic lists them among the keys of an error.
ONE, EACH, NAME = "one number", "one for each", "a name"
_TAGS = (ONE, EACH, NAME)
one_or_each = Discriminator(lambda value: EACH if isinstance(value, list | tuple) else ONE)
number_or_name = Discriminator(lambda value: NAME if isinstance(value, str) else ONE)


class Table(BaseModel):
    """An immutable table that refuses unknown keys, other types and infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def read_toml(path: PathLike) -> dict[str, Any]:
    """Read the tables of a TOML file; `InputError` as `read_text`, and if it is not valid TOML."""
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise input_error("file", "valid TOML", f"{error!s:.200}", path) from error


def one_line(error: ValidationError, model: type[BaseModel], also: Mapping[str, Sequence[str]]) -> str:
    """Describe the first three problems of a table as "`KEY` must be ALLOWED, got VALUE; ...".

    Parameters
    ----------
    error
        What pydantic raised.
    model
        Its fields are the keys; the description of a field says what is allowed.
    also
        Keys of each inner table that the file may have beside those of the model.
    """
    problems = error.errors(include_url=False)
    # Pydantic reports a wrong element a second time, as an array that lacks it.
    inner = {problem["loc"][:end] for problem in problems for end in range(1, len(problem["loc"]))}
    problems = [problem for problem in problems if problem["loc"] not in inner]
    lines = []
    for problem in problems[:3]:
        place = problem["loc"]
        if not place or (problem["type"] == "value_error" and isinstance(place[-1], int)):  # of the whole table
            where = f"`{_dotted(place)}`: " if place else ""
            lines.append(where + problem["msg"].removeprefix("Value error, "))
        elif problem["type"] == "extra_forbidden":
            lines.append(f"`{_dotted(place)}`: no such key; {_nearest(place, model, _keys(model, also))}")
        else:
            given = "nothing" if problem["type"] == "missing" else short_repr(problem["input"])
            lines.append(f"`{_dotted(place)}` must be {_walk(place, model)[1]}, got {given}")
    more = len(problems) - len(lines)
    return "; ".join([*lines, f"and {more} more problems"] if more else lines)


def _dotted(place: Place) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place if step not in _TAGS)
    return "".join(steps).removeprefix(".")


def table_of(annotation: Any) -> type[BaseModel] | None:
    """The table that a field is, or has a list or a dictionary of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((table for part in get_args(annotation) if (table := table_of(part))), None)


def _walk(place: Place, model: type[BaseModel]) -> tuple[type[BaseModel], str]:
    """The innermost table at a place, and the description of the field there, or of the list that it is in."""
    description = ""
    for step in place:
        if field := model.model_fields.get(str(step)):  # none for an index of a list, or a name
            description = field.description or description
            model = table_of(field.annotation) or model
    return model, description


def _keys(model: type[BaseModel], also: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return the keys of each inner table, and those of the top level as ''."""
    keys = {"": list(model.model_fields)}
    for name, field in model.model_fields.items():
        if table := table_of(field.annotation):
            keys[name] = [*table.model_fields, *also.get(name, ())]
    return keys


def _nearest(place: Place, model: type[BaseModel], keys: Mapping[str, Sequence[str]]) -> str:
    """Suggest the same key of another table, a similar key, or else every key of this table."""
    *tables, wrong = (str(step) for step in place)
    here = keys.get(".".join(tables)) or list(_walk(tuple(tables), model)[0].model_fields)
    everywhere = {}
    for table, names in keys.items():
        for key in names:
            everywhere.setdefault(key, f"{table}.{key}".removeprefix("."))
    if wrong in everywhere:
        return f"did you mean `{everywhere[wrong]}`, in its own table?"
    if near := difflib.get_close_matches(wrong, here, n=1):
        return f"did you mean `{near[0]}`?"
    if near := difflib.get_close_matches(wrong, everywhere, n=1, cutoff=0.8):
        return f"did you mean `{everywhere[near[0]]}`?"
    return f"the keys are {', '.join(f'`{key}`' for key in here)}"
