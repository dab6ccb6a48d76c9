"""For griffe: an `eqx.Module` is made of its fields, and parameters that share their words have a type each."""

import griffe


class Modules(griffe.Extension):
    """Gives each `eqx.Module` the signature that it has when it runs."""

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        """Fields in their order, with their defaults."""
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
        """Of `image, imager, grid` griffe takes the first one's type for all."""
        left: list[griffe.Object | griffe.Alias] = [pkg]
        while left:
            each = left.pop()
            if each.is_alias:
                continue
            left += each.members.values()
            if each.docstring and (each.is_function or each.is_class):
                _own_types(each, each.docstring)


def _own_types(each: griffe.Object | griffe.Alias, words: griffe.Docstring) -> None:
    types = {parameter.name: parameter for parameter in getattr(each, "parameters", ())}
    # What has no words, `reference.missing` tells, of public names alone.
    words.parser, words.parser_options = "numpy", {"warnings": False}
    for section in words.parsed:
        for said in section.value if section.kind is griffe.DocstringSectionKind.parameters else ():
            if said.name in types:
                said.annotation, said.default = types[said.name].annotation, types[said.name].default


def _default(value: str | griffe.Expr | None) -> str | griffe.Expr | None:
    if not isinstance(value, griffe.ExprCall):
        return value
    said = [each for each in value.arguments if isinstance(each, griffe.ExprKeyword) and each.name == "default"]
    return said[0].value if said else None
