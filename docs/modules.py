"""Griffe extension: signatures of `eqx.Module`s from fields, and types of parameters with a shared description."""

import griffe


class Modules(griffe.Extension):
    """Gives each `eqx.Module` the signature of its generated `__init__`."""

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        """Build `__init__` from the fields, in their order, with their defaults."""
        if "eqx.Module" not in map(str, cls.bases) or "__init__" in cls.members:
            return
        named = griffe.ParameterKind.positional_or_keyword
        fields = [
            griffe.Parameter(name, annotation=field.annotation, kind=named, default=_default(field.value))
            for name, field in cls.members.items()
            if isinstance(field, griffe.Attribute) and "property" not in field.labels and field.annotation
        ]
        cls.set_member("__init__", griffe.Function("__init__", parameters=griffe.Parameters(*fields)))

    def on_package(self, *, pkg: griffe.Module, **_) -> None:
        """Restore the types of parameters such as `image, imager, grid`, for which griffe uses that of the first."""
        left: list[griffe.Object | griffe.Alias] = [pkg]
        while left:
            each = left.pop()
            if each.is_alias:
                continue
            left += each.members.values()
            if each.docstring and (each.is_function or each.is_class):
                _restore_types(each, each.docstring)


def _restore_types(each: griffe.Object | griffe.Alias, docstring: griffe.Docstring) -> None:
    types = {parameter.name: parameter for parameter in getattr(each, "parameters", ())}
    # `reference.missing` reports missing descriptions of public names, so griffe need not.
    docstring.parser, docstring.parser_options = "numpy", {"warnings": False}
    for section in docstring.parsed:
        for said in section.value if section.kind is griffe.DocstringSectionKind.parameters else ():
            if said.name in types:
                said.annotation, said.default = types[said.name].annotation, types[said.name].default


def _default(value: str | griffe.Expr | None) -> str | griffe.Expr | None:
    if not isinstance(value, griffe.ExprCall):
        return value
    said = [each for each in value.arguments if isinstance(each, griffe.ExprKeyword) and each.name == "default"]
    return said[0].value if said else None
