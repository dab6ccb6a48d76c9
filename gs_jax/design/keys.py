"""Documentation of design keys: comments in files, the schema for editors and the page of keys.

All of it is read from the fields of the tables, whose titles are meanings and whose descriptions are allowed values.
"""

import textwrap
from collections.abc import Iterator
from typing import Any, NamedTuple, get_origin

from pydantic import BaseModel, ValidationError

from ..io.toml import table_of
from .design import Design, as_toml
from .tables import LENS_KEYS, CentersTable
from .validation import USUAL, unit_of

FRAME = (
    "Lengths have the unit that their key ends in. +x is along a row of the image as it is shown (right), +y along a "
    "column (down), both from the sensor's middle; depths z are positive from the array's front toward the object, the "
    "sensor distance v is positive from its back to the sensor."
)
# Tables at the end of a commented file: the centres are long.
_LAST = ("array", "provenance")
_WIDTH = 110


class Key(NamedTuple):
    """A key of a design file. `table` is empty at the top level, `usual` where there is no usual range."""

    table: str
    name: str
    unit: str
    meaning: str
    allowed: str
    usual: str
    required: bool

    @property
    def path(self) -> str:
        return f"{self.table}.{self.name}".removeprefix(".")


def design_keys() -> dict[str, Key]:
    """All keys of design files by their path, such as `sensor.shape`, in the order of the tables."""
    return {key.path: key for key in _all_keys()}


def problem(path: str, value: Any) -> str | None:
    """The error of a value of the key at `path`, checked by itself; None if it is allowed."""
    table, _, name = path.partition(".")
    try:
        Design.model_validate({table: {name: value}})
    except ValidationError as error:  # as all others are missing
        if any(found["loc"][:2] == (table, name) for found in error.errors()):
            return f"must be {design_keys()[path].allowed}, got {value}."
    return None


def commented(design: Design) -> str:
    """A design as TOML with a comment on each key."""
    known, data = design_keys(), design.model_dump(exclude_defaults=True)
    lines = [*_comment(f"A microscope for gs-jax. {FRAME}"), "", *_comment(_comment_text(known["name"]))]
    lines.append(as_toml({"name": design.name}).rstrip())
    tables = [table for table in data if table != "name"]
    for table in sorted(tables, key=lambda table: (table in _LAST, table == _LAST[1])):
        lines += ["", *_comment(f"{_title(table)}."), f"[{table}]"]
        if table == "provenance":
            lines.append(as_toml({table: data[table]}).partition("\n")[2].rstrip())
            continue
        if table == "samples":
            lines[-1] = as_toml({table: data[table]}).rstrip()
            continue
        for name, value in data[table].items():
            lines += _comment(_comment_text(known[f"{table}.{name}"]))
            inner = [key for key in known.values() if key.table == f"{table}.{name}"]
            lines += [line for key in inner for line in _comment(f"{key.name}: {_comment_text(key)}")]
            lines.append(as_toml({name: value}).rstrip())
    return "\n".join(lines) + "\n"


def schema() -> dict[str, Any]:
    """The JSON schema of design files, for editors."""
    made = Design.model_json_schema()
    array, more = made["$defs"]["ArrayTable"], CentersTable.model_json_schema()
    array["properties"] |= more["properties"]
    array["required"].remove("centers_mm")
    array["oneOf"] = [{"required": [name]} for name in ("centers_mm", "centers_file")]
    # The centres file may have these columns.
    lens = made["$defs"]["LensTable"]
    lens["required"] = [name for name in lens["required"] if name not in LENS_KEYS]
    for table, model in _models().items():
        where = made["$defs"][model.__name__] if table else made
        for name, field in where["properties"].items():
            key = design_keys()[f"{table}.{name}".removeprefix(".")]
            field.pop("title", None)
            field["description"] = _comment_text(key)
    file = {"type": "string", "minLength": 1, "description": "in place of `spectrum_nm`: the name of a CSV file"}
    made["$defs"]["ImagingTable"]["properties"]["spectrum_file"] = file
    return {"$schema": "http://json-schema.org/draft-07/schema#"} | _for_toml(made) | {"title": "A design of gs-jax"}


def _models(table: str = "", model: type[BaseModel] = Design) -> dict[str, type[BaseModel]]:
    """A table and those in it by their names; those of `[samples]` have the keys of `[sample]`."""
    found = {table: model}
    for name, field in model.model_fields.items():
        if get_origin(field.annotation) is not dict and (inner := table_of(field.annotation)):
            found |= _models(f"{table}.{name}".removeprefix("."), inner)
    return found


def _all_keys() -> Iterator[Key]:
    for table, model in _models().items():
        fields = model.model_fields | (CentersTable.model_fields if table == "array" else {})
        for name, field in fields.items():
            path = f"{table}.{name}".removeprefix(".")
            unit = unit_of(name)
            low, high = USUAL.get(path, (None, None))
            usual = f"{low:g} to {high:g} {unit}".rstrip() if low is not None else ""
            yield Key(table, name, unit, field.title or "", field.description or "", usual, field.is_required())


def _comment_text(key: Key) -> str:
    """Meaning, allowed values and usual range of a key."""
    allowed = f"; {key.allowed}" if key.allowed != "a table" else ""
    return f"{key.meaning}{allowed}{f'; usually {key.usual}' if key.usual else ''}"


def _title(table: str) -> str:
    title = Design.model_fields[table].title or ""
    return title[:1].upper() + title[1:]


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, _WIDTH, break_on_hyphens=False)]


def _for_toml(node: Any) -> Any:
    """Remove null, which TOML lacks, and `prefixItems` (draft 2020-12), which not all editors know."""
    if isinstance(node, list):
        return [_for_toml(each) for each in node]
    if not isinstance(node, dict):
        return node
    node = {key: _for_toml(value) for key, value in node.items() if value is not None}
    choices = [each for each in node.get("anyOf", ()) if each != {"type": "null"}]
    if len(choices) == 1:
        node = {key: value for key, value in node.items() if key != "anyOf"} | choices[0]
    if items := node.pop("prefixItems", None):
        node["items"] = items[0]
    return node
