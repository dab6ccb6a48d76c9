"""Units of length in files: how they are spelled, and what they are in mm."""

import re

from ..base.errors import InputError

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
