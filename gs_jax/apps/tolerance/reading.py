"""Tolerances in files."""

import tomllib

from pydantic import ValidationError

from ...base.errors import InputError
from ...io.files import read_text
from ...io.toml import one_line
from ...typing import PathLike
from .tolerance_spec import Tolerances


def read_tolerances(path: PathLike) -> Tolerances:
    """The tolerances in a TOML file, whose keys are the fields of `Tolerances`; what it leaves out has its default.

    Raises
    ------
    InputError
        If it cannot be read, or a key does not exist or has a value that is not allowed.
    """
    text = read_text(path)
    try:
        return Tolerances.model_validate(tomllib.loads(text))
    except ValidationError as error:
        raise InputError(f"{path}: {one_line(error, Tolerances, {})}.") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {str(error):.200}.") from error
