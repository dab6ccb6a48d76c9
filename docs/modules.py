"""Griffe extension: signatures of `eqx.Module`s from fields, and parameters with a shared description in one entry."""

import itertools

import griffe

_MODULES = {"eqx.Module", "lx.AbstractLinearOperator"}


class Modules(griffe.Extension):
    """Gives each `eqx.Module` the signature of its generated `__init__`."""

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        """Build `__init__` from the fields, in their order, with their defaults."""
        if not _MODULES & set(map(str, cls.bases)) or "__init__" in cls.members:
            return
        named = griffe.ParameterKind.positional_or_keyword
        fields = [
            griffe.Parameter(name, annotation=field.annotation, kind=named, default=_default(field.value))
            for name, field in cls.members.items()
            if isinstance(field, griffe.Attribute) and "property" not in field.labels and field.annotation
        ]
        cls.set_member("__init__", griffe.Function("__init__", parameters=griffe.Parameters(*fields)))

    def on_package(self, *, pkg: griffe.Module, **_) -> None:
        """Show parameters with a shared description, such as `imager, grid`, in one entry with the types of all."""
        left: list[griffe.Object | griffe.Alias] = [pkg]
        while left:
            item = left.pop()
            if item.is_alias:
                continue
            left += item.members.values()
            if item.docstring and (item.is_function or item.is_class):
                _join_parameters(item, item.docstring)


def _join_parameters(item: griffe.Object | griffe.Alias, docstring: griffe.Docstring) -> None:
    """Join neighbours that griffe made of one entry: each has its text, and the type of the first."""
    types = {parameter.name: parameter for parameter in getattr(item, "parameters", ())}
    # `reference.missing` reports missing descriptions of public names, so griffe need not.
    docstring.parser, docstring.parser_options = "numpy", {"warnings": False}
    for section in docstring.parsed:
        if section.kind is griffe.DocstringSectionKind.parameters:
            groups = itertools.groupby(section.value, key=lambda parameter: parameter.description)
            section.value = [_joined([parameter.name for parameter in group], text, types) for text, group in groups]


def _joined(names: list[str], text: str, types: dict[str, griffe.Parameter]) -> griffe.DocstringParameter:
    known = [types[name] for name in names if name in types]
    annotations = list({str(p.annotation): p.annotation for p in known if p.annotation is not None}.values())
    defaults = list({str(p.default): p.default for p in known if p.default is not None}.values())
    return griffe.DocstringParameter(
        ", ".join(names), annotation=_tuple(annotations), description=text, value=_tuple(defaults)
    )


def _tuple(values: list[str | griffe.Expr]) -> str | griffe.Expr | None:
    if len(values) > 1:
        return griffe.ExprTuple(values, implicit=True)
    return values[0] if values else None


def _default(value: str | griffe.Expr | None) -> str | griffe.Expr | None:
    if not isinstance(value, griffe.ExprCall):
        return value
    said = [each for each in value.arguments if isinstance(each, griffe.ExprKeyword) and each.name == "default"]
    return said[0].value if said else None
