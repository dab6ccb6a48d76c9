"""Names of files and columns as data: numbers, units of length, gaps in series, and text for any file format."""

import itertools
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import TypeVar

from ..base.errors import InputError

Name = TypeVar("Name", bound=str | PurePath)

# A unit after a number. Lengths alone: other units are compared by their letters.
_UNIT_AFTER = re.compile(r"([nmcuµμ]m)(?![a-z])", re.IGNORECASE)
# Numbers, with decimals unless they have two points, as versions and dates, and what divides decimals.
_NUMBER = re.compile(r"((?<![\d.,])\d+(?:[.,]|p(?=\d+[nmcuµμ]m))\d+(?![.,]?\d)|\d+)")
_POINT = re.compile("[.,p]")
_SIGNS = {"-": -1, "−": -1, "+": 1}
# Characters that XML 1.0 cannot hold, and bytes of a name that are not UTF-8, which Python reads as surrogates.
_NOT_TEXT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f\ud800-\udfff\ufffe\uffff]")


# Millimetres of a unit, and its spellings: symbols as in OME, words as in NGFF, and what people write.
_UNITS = {
    "nm": (1e-6, "nm nanometer nanometers nanometre nanometres"),
    "um": (1e-3, "um µm μm micron microns micrometer micrometers micrometre micrometres"),
    "mm": (1.0, "mm millimeter millimeters millimetre millimetres"),
    "cm": (10.0, "cm centimeter centimeters centimetre centimetres"),
    "dm": (100.0, "dm decimeter decimetre"),
    "m": (1000.0, "m meter meters metre metres"),
    "in": (25.4, 'in inch inches "'),
    "ft": (304.8, "ft foot feet"),
    "mil": (0.0254, "mil mils thou"),
}
_SPELLINGS = {spelling: unit for unit, (_, spellings) in _UNITS.items() for spelling in spellings.split()}
PIXELS = "px"
_SPELLINGS |= dict.fromkeys(("px", "pix", "pixel", "pixels"), PIXELS)
# Words of headers, too, which are units at the end of a name alone.
_ALSO_WORDS = ("m", "in")
# What follows the letter of an axis without being a unit.
_NO_UNITS = frozenset(
    "abs absolute axis c center centers centre centres col column coord coordinate coordinates data design fit "
    "found lens loc location mean measured new nominal of p pos position positions raw ref rel relative row true value "
    "x y z".split()
)


def plain_text(text: str) -> str:
    r"""Write characters that no XML or UTF-8 can hold as escapes: the byte E9 as `\xe9`."""
    return _NOT_TEXT.sub(lambda match: _escaped(ord(match[0])), text)


def _escaped(code: int) -> str:
    # Python's surrogate of a byte that it cannot decode.
    code = code - 0xDC00 if 0xDC80 <= code <= 0xDCFF else code
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def natural_order(names: Iterable[Name]) -> list[Name]:
    """Sort names by the numbers in them: `z2` before `z10`, and `z10.25` before `z10.5`.

    Numbers may have decimals and signs, and different units of length. A hyphen is a sign at the beginning, after
    anything but a letter or digit, or if other names have none in its place. A point divides two numbers, and not
    decimals, if these decimals end in zeros and are not all of one length (`run1.9`, `run1.10`).
    """
    names = list(names)
    split = [_split(str(name)) for name in names]
    triples = [texts[i - 1 : i + 2] for texts, _ in split for i in range(1, len(texts), 2)]
    decimals = defaultdict(set)
    for before, number, _ in triples:
        if not number.isdecimal():
            decimals[before].add(_POINT.split(number)[1])
    befores = {before for before, *_ in triples}
    counted = {before for before, digits in decimals.items() if not _are_decimals(digits)}
    units = {unit[1].lower() for *_, after in triples if (unit := _UNIT_AFTER.match(after))}

    def key(index: int) -> list:
        texts, suffix = split[index]
        numbers = (_key(texts, i, befores, counted, len(units) > 1) for i in range(1, len(texts), 2))
        # Text and numbers alternate, also where a name ends and another goes on.
        return [*itertools.chain.from_iterable(numbers), texts[-1], -math.inf, suffix, str(names[index])]

    return [names[index] for index in sorted(range(len(names)), key=key)]


def _split(name: str) -> tuple[list[str], str]:
    """Texts and numbers of a name in turn, and its suffix."""
    suffix = PurePath(name).suffix
    suffix = "" if suffix[1:].isdigit() else suffix
    return _NUMBER.split(name.removesuffix(suffix)), suffix


def _are_decimals(digits: set[str]) -> bool:
    return len(set(map(len, digits))) == 1 or not any(text.endswith("0") and text != "0" for text in digits)


def _key(texts: list[str], index: int, befores: set[str], counted: set[str], has_units: bool) -> list:
    """What the number `texts[index]` is compared by, after the text before it."""
    before, number, after = texts[index - 1 : index + 2]
    text, sign = before, 1
    # A hyphen alone stands between two numbers, as in dates, or begins the name.
    can_be = before[-1:] in _SIGNS if before[:-1] else index == 1 and before in _SIGNS
    if can_be and (not before[-2:-1].isalnum() or before[:-1] in befores):
        text, sign = before[:-1], _SIGNS[before[-1]]
    unit = _UNIT_AFTER.match(after) if has_units else None
    scale = sign * (mm_per(unit[1].lower()) if unit else 1)
    whole, *decimals = _POINT.split(number)
    if decimals and before in counted:
        return [text, scale * int(whole), ".", int(decimals[0])]
    return [text, scale * (float(f"{whole}.{decimals[0]}") if decimals else int(whole))]


def first_gap(names: Sequence[str]) -> tuple[str, str] | None:
    """The two names of a numbered series between which numbers are missing; None without a gap.

    In the series all but one whole number is the same in each name.
    """
    split = [re.split(r"(\d+)", name) for name in names]
    if len(set(map(len, split))) != 1 or len(names) < 3:
        return None
    varying = [index for index, texts in enumerate(zip(*split, strict=True)) if len(set(texts)) > 1]
    if len(varying) != 1 or varying[0] % 2 == 0:
        return None
    numbers = [int(texts[varying[0]]) for texts in split]
    steps = [after - before for before, after in zip(numbers[:-1], numbers[1:], strict=True)]
    # Times in names differ a little from step to step.
    gap = next((index for index, step in enumerate(steps) if step >= 1.75 * min(steps)), None)
    return None if gap is None or min(steps) < 1 else (names[gap], names[gap + 1])


def mm_per(spelling: str) -> float:
    """Millimetres of a unit; `KeyError` if it is none of length."""
    return _UNITS[_SPELLINGS[spelling]][0]


def in_mm(numbers, unit: str):
    """Numbers of a unit in mm. Where it is a decimal part of a mm, a division is exact to the last digit."""
    factor = _UNITS[unit][0]
    return numbers / round(1 / factor) if unit in ("nm", "um") else numbers * factor


def unit_of_name(name: str) -> str | None:
    """The unit that a column's name ends in, or has in brackets, as one of `nm`, `um`, ..., or `PIXELS`; or None.

    Raises `InputError` if the unit in brackets, or the word after the letter of an axis, is not known.
    """
    lower = name.lower()
    for inside in re.findall(r"[(\[](.*?)[)\]]", lower):
        inner = [word for word in re.findall(r"[^\W\d_]+|\"", inside) if word not in _NO_UNITS]
        if inner and inner[-1] in _SPELLINGS:
            return _SPELLINGS[inner[-1]]
        if inner:
            raise _unknown(name, inside.strip())
    words = re.findall(r"[^\W\d_]+|\"", lower)
    if words and words[-1] in _SPELLINGS:
        return _SPELLINGS[words[-1]]
    if known := [word for word in words if word in _SPELLINGS and word not in _ALSO_WORDS]:
        return _SPELLINGS[known[-1]]
    if len(words) == 2 and words[0] in ("x", "y", "z") and words[1] not in _NO_UNITS:
        raise _unknown(name, words[1])
    return None


def _unknown(name: str, unit: str) -> InputError:
    units = ", ".join((*_UNITS, PIXELS))
    return InputError(f"column {name!r:.40} must be in {units}, or say nothing, got {unit!r:.40}.")
