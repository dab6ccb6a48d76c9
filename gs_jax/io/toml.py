"""Tables of TOML files, and their problems in one line: the key, what was found and what is allowed."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Discriminator, ValidationError

from ..base.errors import short_repr

Place = tuple[int | str, ...]
# Of a value that is one number or several: pydantic's names for which of the two it is, which are no keys.
ONE, EACH = "one number", "one for each"
one_or_each = Discriminator(lambda value: EACH if isinstance(value, list | tuple) else ONE)


class Table(BaseModel):
    """A table whose keys are its fields: no other keys, no other types, no infinities. It does not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def one_line(error: ValidationError, model: type[BaseModel], also: Mapping[str, Sequence[str]]) -> str:
    """The first three problems of a file that is not a `model`.

    What is allowed is the description of the model's field.

    Parameters
    ----------
    model
        Its fields are keys, and those that are models themselves are tables.
    also
        Keys of each table that the file may have and the model has not.
    """
    problems = error.errors(include_url=False)
    # A wrong element is reported again as an array that lacks it.
    inner = {problem["loc"][:end] for problem in problems for end in range(1, len(problem["loc"]))}
    problems = [problem for problem in problems if problem["loc"] not in inner]
    lines = []
    for problem in problems[:3]:
        place, found = problem["loc"], problem["input"]
        if not place:
            lines.append(problem["msg"].removeprefix("Value error, "))
        elif problem["type"] == "extra_forbidden":
            nearest = _nearest(place, _keys(model, also))
            lines.append(f"`{_dotted(place)}`: found a key that does not exist, allowed: {nearest}")
        else:
            found = "nothing" if problem["type"] == "missing" else short_repr(found)
            lines.append(f"`{_dotted(place)}`: found {found}, allowed: {_allowed(place, model)}")
    more = len(problems) - len(lines)
    return "; ".join([*lines, f"and {more} more problems"] if more else lines)


def _dotted(place: Place) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in place if step not in (ONE, EACH))
    return "".join(steps).removeprefix(".")


def _table(annotation: Any) -> type[BaseModel] | None:
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _allowed(place: Place, model: type[BaseModel]) -> str:
    """The description of the field at `place`, or of the one that it is an element of."""
    description = ""
    for step in place:
        field = model.model_fields.get(str(step))
        if field is None:
            break
        description = field.description or description
        model = _table(field.annotation) or model
    return description


def _keys(model: type[BaseModel], also: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """The keys of each table, and of the top level as ''."""
    keys = {"": list(model.model_fields)}
    for name, field in model.model_fields.items():
        if table := _table(field.annotation):
            keys[name] = [*table.model_fields, *also.get(name, ())]
    return keys


def _nearest(place: Place, keys: Mapping[str, Sequence[str]]) -> str:
    """The key that was meant: one like it in the same table, or in another, or else every key of the table."""
    *tables, wrong = (str(step) for step in place)
    here = keys.get(".".join(tables), [])
    everywhere = {key: f"{table}.{key}".removeprefix(".") for table, names in keys.items() for key in names}
    if wrong in everywhere:
        return f"`{everywhere[wrong]}`, in its own table"
    if near := difflib.get_close_matches(wrong, here, n=1):
        return f"`{near[0]}` (did you mean it?)"
    if near := difflib.get_close_matches(wrong, everywhere, n=1, cutoff=0.8):
        return f"`{everywhere[near[0]]}` (did you mean it?)"
    return ", ".join(f"`{key}`" for key in here)
