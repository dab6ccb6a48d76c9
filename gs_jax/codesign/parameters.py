"""The parameters of a co-design: what of an imager a search may free, and what of its depths a study may.

`Free` names numbers of an imager as its fields do, for `gs_jax.optimize`. The rest is for studies.

`evaluated` gives the imager of a design and its `Conditions`, `start_values` their parameters by name, `candidate` the
imager and conditions of other values, differentiable in all of them, and `new_design` a design file's. Names carry the
unit of the study file, and so do the values here: all are mm but the index, the conic constant and the aspheric terms
A_4, A_6, ..., in mm^-3, mm^-5, .... Where lenses differ, radius, aperture and conic constant are one value a lens type,
in the order of their first lenses; the type of each lens stays.
"""

import dataclasses
from collections.abc import Collection
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Float64
from pydantic import ValidationError

from ..base.errors import InputError
from ..design.design import Design
from ..design.tables import LENS_KEYS
from ..io.toml import one_line
from ..microscope.geometry import Imager
from ..microscope.lenses import EACH
from ..objectives.conditions import DETAIL, Conditions
from ..optics.apertures import pitch

Values = dict[str, Float[Array, "..."]]

# What `Free` calls the parameters of a study; the span of the depths is none of an imager's.
_FIELDS = {
    "sensor_distance_mm": "sensor_distance",
    "radius_of_curvature_mm": "radius_of_curvature",
    "aperture_diameter_mm": "aperture_diameter",
    "refractive_index": "refractive_index",
    "conic_constant": "conic_constant",
    "aspheric_terms": "aspheric_terms",
    "pitch_mm": "pitch",
    "centers_mm": "centers",
}
NAMES = (*_FIELDS, "depth_span_mm")

# Aspheric terms of a lens without any, where they are free.
_TERMS = 2
# Digits of a written length: 0.1 um is finer than a printer, and than a camera's mount.
_DIGITS = 4
# Significant digits of numbers that are no length, as many as float32 has: of a term of the surface picometres of sag.
_SIGNIFICANT = 7
# Of lenses that differ: enough for the mean clear aperture of a type to 1e-3, an eighth of the work of all.
_EDGES = 64


_OF_ARRAY = (
    "centers",
    "radius_of_curvature",
    "aperture_diameter",
    "conic_constant",
    "aspheric_terms",
    "refractive_index",
    "substrate_thickness",
    "size",
)
_OF_IMAGER = ("sensor_distance", "rotation", "shift", "tilt", "wavelength")
_OF_LAYERS = (
    "filters.thickness",
    "filters.refractive_index",
    "windows.thickness",
    "windows.refractive_index",
    "sample.refractive_index",
    "sample.surface",
)


class Free(NamedTuple):
    """Which numbers of an imager are free; `gs_jax.free` makes it."""

    names: tuple[str, ...]

    def values(self, imager: Imager) -> Values:
        """The free numbers by name. What lenses have of their own is one number for each lens type."""
        if missing := [name for name in self.names if _leaf(imager, name) is None]:
            raise InputError(f"free: {missing[0]} must be a number of the imager (it may be zero), got None.")
        if "pitch" in self.names and len(imager.array.centers) < 2:
            raise InputError("free: pitch must be that of two lenses or more, got a single lens.")
        values = {name: _leaf(imager, name) for name in self.names}
        for name in self.names:
            if name in EACH and not imager.array.alike:
                # A number that all types share may differ between them in a search.
                values[name] = jnp.broadcast_to(values[name], imager.array.type_count)
        return values

    def replaced(self, imager: Imager, values: Values) -> Imager:
        """The imager with other numbers. A pitch scales the lens centres and the plate about the middle."""
        names = [name for name in self.names if name != "pitch"]
        scale = values["pitch"] / _leaf(imager, "pitch") if "pitch" in self.names else None
        imager = eqx.tree_at(lambda i: [_leaf(i, name) for name in names], imager, [values[name] for name in names])
        if scale is None:
            return imager
        lengths = lambda i: [i.array.centers] if i.array.size is None else [i.array.centers, i.array.size]
        return eqx.tree_at(lengths, imager, replace_fn=lambda length: scale * length)


def free(*names: str) -> Free:
    """Which numbers of an imager a search may change.

    *Host.*

    Parameters
    ----------
    names
        Fields of `Imager` and of `MicrolensArray`: `"sensor_distance"`, `"rotation"`, `"shift"`, `"tilt"`,
        `"wavelength"`; `"centers"`, `"radius_of_curvature"`, `"aperture_diameter"`, `"conic_constant"`,
        `"aspheric_terms"`, `"refractive_index"`, `"substrate_thickness"`, `"size"`. Where lenses differ, radius,
        aperture and conic constant are free for each lens type, and the type of each lens stays. `"pitch"` is the mean
        distance of nearest neighbours: it scales the pattern and the plate. Of layers, one number each:
        `"filters.thickness"`, `"windows.thickness"`, and with `"refractive_index"` in place of that; of the medium
        `"sample.refractive_index"`, `"sample.surface"`.

    Raises
    ------
    InputError
        If there is no such field, or none is named.

    Examples
    --------
    >>> gs.free("centers", "sensor_distance").names
    ('centers', 'sensor_distance')
    """
    known = (*_OF_IMAGER, *_OF_ARRAY, *_OF_LAYERS, "pitch")
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"free: names must be among {', '.join(known)}, got {wrong[0]!r}.")
    if not names:
        raise InputError(f"free: at least one name must be given, of {', '.join(known)}.")
    return Free(tuple(dict.fromkeys(names)))


def _leaf(imager, name):
    if name == "pitch":
        return pitch(imager.array.centers)[0]
    at: Any = imager.array if name in _OF_ARRAY else imager
    for part in name.split("."):
        at = None if at is None else getattr(at, part)
    return at


def evaluated(
    design: Design,
    *,
    depths_mm: tuple[float, float] | None = None,
    circle_of_confusion: float | None = None,
    depth_count: int = 6,
    exposure: float = 1e4,
    detail: float = DETAIL,
    free: Collection[str] = (),
) -> tuple[Imager, Conditions]:
    """The imager of a design and the conditions under which a search evaluates it.

    Parameters
    ----------
    depths_mm
        Nearest and farthest depth; by default the design's working distance.
    circle_of_confusion
        Diameter of the circle of confusion, mm; two pixels by default.
    depth_count
        Depths between them, both included.
    exposure, detail
        As of `Conditions`.
    free
        Names of the parameters that will be replaced.
    """
    near, far = depths_mm or design.imaging.working_distance_mm
    imager = design.imager()
    dtype = imager.sensor_distance.dtype
    if "aspheric_terms" in free and not imager.array.aspheric_terms.size:
        imager = eqx.tree_at(lambda i: i.array.aspheric_terms, imager, jnp.zeros(_TERMS, dtype))
    at = Conditions(
        depths_between(jnp.asarray((near + far) / 2, dtype), jnp.asarray(far - near, dtype), depth_count),
        circle_of_confusion,
        exposure=exposure,
        detail=detail,
        directions=_EDGES,
    )
    return imager, at


def depths_between(middle: Float[Array, ""], span: Float[Array, ""], count: int) -> Float[Array, " depth"]:
    """Evenly spaced depths about a middle, mm."""
    return middle + span * jnp.linspace(-0.5, 0.5, count, dtype=middle.dtype)


def _fields_of(imager: Imager) -> dict[str, str]:
    """What `Free` calls the parameters that an imager has, by their names; a single lens has no pitch."""
    single = len(imager.array.centers) == 1
    return {name: field for name, field in _FIELDS.items() if not (single and field == "pitch")}


def start_values(imager: Imager, at: Conditions) -> Values:
    """Every parameter by name. Of lenses that differ, radius, aperture and conic constant have one value a type.

    The pitch of a single lens is 1.
    """
    fields, span = _fields_of(imager), at.depths[-1] - at.depths[0]
    numbers = Free(tuple(fields.values())).values(imager)
    own = {name: numbers[field] for name, field in fields.items()}
    return {"pitch_mm": jnp.ones_like(span), "depth_span_mm": span} | own


def candidate(imager: Imager, at: Conditions, values: Values) -> tuple[Imager, Conditions]:
    """An imager and its conditions with some parameters replaced; differentiable in all of them.

    `values`: by name, any subset of `NAMES`. A pitch scales the pattern and the plate about the middle; `centers_mm`
    are the centres before that.
    """
    values = start_values(imager, at) | values
    numbers = {field: values[name] for name, field in _fields_of(imager).items()}
    depths = depths_between(at.middle.depths[0], values["depth_span_mm"], at.depths.size)
    return Free(tuple(numbers)).replaced(imager, numbers), dataclasses.replace(at, depths=depths)


def new_design(design: Design, imager: Imager, at: Conditions, values: Values) -> Design:
    """The design of these values as a file holds it: the working distance is the one that was asked for.

    Lengths and the refractive index are to four decimals (0.1 um), conics and aspheric terms to seven significant
    digits.

    Raises `InputError` if the values make no microscope.
    """
    start = start_values(imager, at)
    values = start | values
    shared = ("sensor_distance_mm", "refractive_index", "depth_span_mm")
    numbers = {name: round(float(values[name]), _DIGITS) for name in shared}
    scale = float(values["pitch_mm"] / start["pitch_mm"])
    size = [round(scale * side, _DIGITS) for side in design.array.size_mm]
    # Rounding may not push a lens off the plate.
    half = np.array(size) / 2
    centers = np.clip(np.round(scale * np.asarray(values["centers_mm"], float), _DIGITS), -half, half)
    middle = float(at.depths[0] + at.depths[-1]) / 2
    working = [round(middle + sign * numbers["depth_span_mm"] / 2, _DIGITS) for sign in (-1, 1)]
    data = design.model_dump()
    data["lens"] |= {name: _of_lenses_rounded(imager, name, values[name]) for name in LENS_KEYS}
    # A material stays unless its index was searched for.
    if not isinstance(design.lens.refractive_index, str) or values["refractive_index"] != imager.array.refractive_index:
        data["lens"] |= {"refractive_index": numbers["refractive_index"]}
    data["lens"] |= {"aspheric_terms": significant(values["aspheric_terms"]).tolist()}
    data["array"] |= {"size_mm": size, "centers_mm": centers.tolist()}
    data["imaging"] |= {"sensor_distance_mm": numbers["sensor_distance_mm"], "working_distance_mm": working}
    try:
        return Design.model_validate(data)
    except ValidationError as error:
        raise InputError(f"the values found make no microscope: {one_line(error, Design, {})}.") from error


def significant(value: ArrayLike) -> Float64[np.ndarray, "..."]:
    """Numbers to seven significant digits."""
    numbers = np.asarray(value, float)
    return np.array([float(f"{number:.{_SIGNIFICANT}g}") for number in numbers.flat]).reshape(numbers.shape)


def _of_lenses_rounded(imager: Imager, name: str, value: Float[Array, "..."]) -> float | list[float]:
    """One number if all types come to the same."""
    numbers = value if value.ndim == 0 else value[imager.array.type_of_lens]
    numbers = np.round(np.asarray(numbers, float), _DIGITS) if name.endswith("_mm") else significant(numbers)
    return numbers.tolist() if np.ptp(numbers) else float(numbers.flat[0])
