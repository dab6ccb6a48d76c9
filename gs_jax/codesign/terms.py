"""Terms of a study: objectives by name, in the unit that the name ends in.

A term's function takes an imager and its `Conditions` and gives a number or an array of them (over depths, lens types,
lenses, points). Terms of your own are added by a package's entry point, by `add_terms`, or to `TERMS`; see `Term`. A
study names terms, it never imports code.

Terms that judge the layout, and those at equal exposure, apply `array_psf`, `fisher`, `linear_error` and `end_to_end`
at points, depths and frequencies that follow from the imager and its conditions. Points lie where they see a whole
field of lenses. Random terms draw new ones for each key.
"""

import dataclasses
import difflib
import hashlib
import math
import runpy
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import entry_points
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .. import objectives
from ..base.errors import InputError, input_error, short_repr
from ..geometry import Imager, field_limit
from ..grid import Grid
from ..io.files import check_input, check_suffix
from ..objectives.conditions import Conditions, finite_plate, per_type
from ..optics.lens_types import only
from ..typing import PathLike
from .array_psf import array_spectrum, condition_number, mean_inverse_views, sidelobes, spectral_flatness
from .end_to_end import reconstruction_loss
from .fisher import crowded_bound, localization_bound
from .linear_error import PLACE, lens_electrons, lost_power, spots

Built = TypeVar("Built")

UM = 1000.0
# The group of entry points that are terms.
_GROUP = "gs_jax.terms"
# Numbers of sources and targets for sidelobes, of points that are located or whose spectrum is computed; and electrons
# a lens of a point.
_SOURCES, _TARGETS, _POINTS, _PHOTONS = 4, 256, 4, 1000.0
# Spatial frequencies of a spectrum.
_FREQUENCIES = 256
# Points along a side of the plate.
_RASTER = 15
# Voxels along a side of a random scene, blobs per voxel, each as wide as a voxel; scenes of a draw.
_VOXELS, _DENSITY, _SCENES = 99, 0.008, 2
# Places along a side of the part of the plate whose points see a whole field of lenses.
_PLACES = 2
# Side of a lens's own spot, pixels.
_SPOT = 65


def ghosts(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """RMS sidelobe of random points at random targets, relative to the peak; spots are a pixel wide."""
    near, far = jax.random.split(key)
    sources, targets = _points(imager, at, near, _SOURCES), _points(imager, at, far, _TARGETS)
    pixel = imager.sensor.pixel_pitch
    size = 4 * pixel / imager.magnification(at.depths)[0]
    axial = size * imager.depth_in_medium(at.depths)[0] / imager.field_radius
    return sidelobes(imager, sources, targets, width=pixel, lateral=size, axial=axial).rms


def shortage(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """`mean_inverse_views` over the whole plate, at the middle depth."""
    plate = finite_plate(imager)
    side = jnp.linspace(-0.5, 0.5, _RASTER, dtype=plate.dtype)
    places = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * plate[None]
    depth = jnp.broadcast_to(at.middle.depths, (len(places), 1))
    return mean_inverse_views(imager, jnp.concatenate([places, depth], 1))


def flatness(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`spectral_flatness` of random points at random frequencies."""
    return spectral_flatness(_spectrum(imager, at, key))


def conditioning(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`condition_number` of the same spectrum."""
    return condition_number(_spectrum(imager, at, key))


def _spectrum(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, "point frequency"]:
    """Power at frequencies between `1 / field_radius` and Nyquist, log-uniform, in all directions."""
    place, size, angle = jax.random.split(key, 3)
    low, high = 1 / imager.field_radius, 0.5 / imager.sensor.pixel_pitch
    draw = lambda key: jax.random.uniform(key, (_FREQUENCIES,), at.depths.dtype)
    frequency, turn = low * (high / low) ** draw(size), jnp.pi * draw(angle)
    frequencies = jnp.stack([frequency * jnp.cos(turn), frequency * jnp.sin(turn)], 1)
    return array_spectrum(imager, _points(imager, at, place, _POINTS), frequencies)


def localization(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, "3"]:
    """Cramer-Rao bound of x, y, z at random points, um; the spot has a standard deviation of one pixel."""
    points, spot = _points(imager, at, key, _POINTS), imager.sensor.pixel_pitch
    return 1000 * localization_bound(imager, points, photons=_PHOTONS, spot=spot)


def log_error(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """Logarithm of the relative error, `sqrt(1 - <a,b>^2 / (<a,a> <b,b>))`, of reconstructed random scenes.

    Scenes have three depths of 99 x 99 voxels, as wide as the field of a lens, at a random place of the plate:
    sub-images overlap as much as those of an object that fills the field. Spots are points, and all lenses have the
    same light.
    """
    return _log_error(imager, at, key)


def log_error_for_exposure(imager: Imager, at: Conditions, key: PRNGKeyArray) -> Float[Array, ""]:
    """`log_error` with the lenses' own spots and the light of the exposure."""
    at = dataclasses.replace(at, depths=_three(at))
    # `forward` does not scale light with the depth: all three planes have the mean.
    share = (_voxel_pitch(imager) / PLACE) ** 2

    def of_type(imager, at):
        return only(imager, at.lenses), spots(imager, at, _SPOT), share * jnp.mean(lens_electrons(imager, at))

    return _log_error(imager, at, key, types=[of_type(*part) for part in per_type(imager, at)])


def _three(at: Conditions) -> Float[Array, "3"]:
    return jnp.concatenate([at.depths[:1], at.middle.depths, at.depths[-1:]])


def _voxel_pitch(imager: Imager) -> float:
    """Pitch of the voxels of a random scene, mm."""
    return 2 * imager.field_radius / _VOXELS


def _log_error(imager: Imager, at: Conditions, key: PRNGKeyArray, **light) -> Float[Array, ""]:
    sensor, reach = imager.sensor, imager.field_radius
    depths, pitch = _three(at), _voxel_pitch(imager)
    # Distance of a voxel from its image by the farthest lens that sees it.
    beside = (1 + at.largest_magnification) * field_limit(reach)
    rows, columns = (math.ceil(min(n, 2 * (reach + beside) / sensor.pixel_pitch)) for n in sensor.shape)
    height, width = (max(0.0, n * sensor.pixel_pitch - 4 * reach) for n in sensor.shape)
    found = reconstruction_loss(
        imager,
        key,
        grid=Grid(depths, (_VOXELS, _VOXELS), pitch),
        scenes=_SCENES,
        density=_DENSITY,
        width=pitch,
        background_width=4 * pitch,
        window=(rows, columns),
        field=(width, height),
        **light,
    )
    return found * jnp.log(jnp.asarray(10.0, found.dtype)) / 20


def _inner_plate(imager: Imager) -> Float[Array, "2"]:
    """Size of the part of the plate a field radius from its edge, or a quarter of the plate where that is larger."""
    plate = finite_plate(imager)
    return jnp.maximum(plate - 2 * imager.field_radius, plate / 4)


def _points(imager: Imager, at: Conditions, key: PRNGKeyArray, count: int) -> Float[Array, "point 3"]:
    """Random points over the depths and the field, a field radius from the plate's edge where it is that large."""
    inner = _inner_plate(imager)
    middle = jnp.stack([0 * inner[0], 0 * inner[0], at.middle.depths[0]])
    size = jnp.stack([inner[0], inner[1], at.depths[-1] - at.depths[0]])
    return middle[None] + size[None] * jax.random.uniform(key, (count, 3), inner.dtype, -0.5, 0.5)


def volume_error(imager: Imager, at: Conditions) -> Float[Array, ""]:
    """Relative error of volumes by the best linear estimate: the root of the mean of `lost_power` over the depths."""
    return jnp.sqrt(jnp.mean(lost_power(imager, at, places_of(imager))))


def crowded_precision(imager: Imager, at: Conditions) -> Float[Array, "depth 3"]:
    """`crowded_bound` of x, y, z at each depth, um."""
    return 1000 * crowded_bound(imager, at, places_of(imager))


def places_of(imager: Imager) -> Float[Array, "place 2"]:
    """Four points that stand for the plate, a field radius from its edge where it is that large, mm."""
    inner = _inner_plate(imager)
    side = jnp.asarray((np.arange(_PLACES) + 0.5) / _PLACES - 0.5, inner.dtype)
    return jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2) * inner[None]


class Term(NamedTuple):
    """A term: its meaning in words, and its function of an imager and `Conditions`.

    With `log` the function gives the value's logarithm; with `random` it takes a key as a third argument. `source` is
    the hash of the file that `add_terms` read it from, by which a checkpoint knows whether its terms have changed.
    """

    meaning: str
    function: Callable[..., Float[Array, "..."]]
    log: bool = False
    random: bool = False
    source: str = ""


def _scaled(unit, function):
    return lambda imager, at: unit * function(imager, at)


def _of_imager(function):
    return lambda imager, at: function(imager)


def _in_the_middle(function):
    return lambda imager, at: function(imager, at.middle)[..., 0]


TERMS: dict[str, Term] = {
    "lateral_resolution_um": Term("lateral resolution in focus (Eq. 5)", _scaled(UM, objectives.lateral_resolution)),
    "axial_resolution_um": Term("axial resolution in focus (Eq. 6)", _scaled(UM, objectives.axial_resolution)),
    "depth_of_field_mm": Term("depth of field (Eq. 8)", _in_the_middle(objectives.depth_of_field)),
    "depth_of_field_eq7_mm": Term("depth of field (Eq. 7)", _in_the_middle(objectives.approximate_depth_of_field)),
    "focus_offset": Term("focus from the middle of the depths, 1 at their ends", objectives.focus_offset),
    "blur_um": Term("diameter of the thin lens's blur, in the object", _scaled(UM, objectives.blur)),
    "strehl": Term("Strehl ratio over the field (Eqs. 9, 10)", objectives.log_strehl, log=True),
    "wavefront_waves": Term("RMS wavefront error over the field", objectives.wavefront_error),
    "lenses_per_point": Term("lenses that see a point, N_e", objectives.lenses_per_point),
    "occupancy": Term("occupancy V (Eq. 11)", objectives.occupancy),
    "light_percent": Term("share of a point's light that is used", _scaled(100, objectives.light)),
    "field_of_view_mm": Term("width of the field of view", objectives.field_of_view),
    "thickness_mm": Term("thickness: filters, plate and sensor distance", _of_imager(objectives.thickness)),
    "fwhm_um": Term("full width at half maximum of the PSF on the axis, in the object", _scaled(UM, objectives.fwhm)),
    "rms_width_um": Term("RMS width of the PSF, in the object", _scaled(UM, objectives.rms_width)),
    "half_light_radius_um": Term("radius of half the light, in the object", _scaled(UM, objectives.half_light_radius)),
    "psf_width_um": Term("2.355 times the RMS width of the PSF, in the object", _scaled(UM, objectives.spot_width)),
    "width_per_light_um": Term(
        "width of the spot over the fourth root of the light in percent", _scaled(UM, objectives.width_per_light)
    ),
    "encircled_radius_um": Term("radius of 80 % of the rays, in the object", _scaled(UM, objectives.encircled_radius)),
    "depth_span_mm": Term("span of the depths", lambda _, at: at.depths[-1] - at.depths[0]),
    "spacing_mm": Term("distance of nearest lenses", _of_imager(objectives.spacing)),
    "web_mm": Term("mask left between neighbouring apertures", _of_imager(objectives.aperture_gap)),
    "hole_mm": Term("distance of a place on the plate from a lens", _of_imager(objectives.uncovered_distance)),
    "coverage": Term("share of the plate that is clear aperture", objectives.coverage),
    "sag_mm": Term("height of a whole lens", objectives.sag),
    "ghosts": Term("RMS sidelobe of the array PSF over its peak", ghosts, random=True),
    "lens_shortage": Term("mean over the plate of one over the lenses that see a point", shortage),
    "spectral_flatness": Term("flatness of the array PSF's spectrum, 1 if white", flatness, random=True),
    "condition_number": Term("largest over smallest power of that spectrum", conditioning, random=True),
    "localization_um": Term("least error of locating a point, x, y, z", localization, random=True),
    "reconstruction_error": Term("relative error of reconstructed scenes", log_error, log=True, random=True),
    "scene_error": Term(
        "relative error of reconstructed scenes, for an exposure", log_error_for_exposure, log=True, random=True
    ),
    "volume_error": Term("relative error of volumes, best linear estimate, for an exposure", volume_error),
    "crowded_precision_um": Term(
        "least error of locating a point in a scene, x, y, z, for an exposure", crowded_precision
    ),
    "edge_slope_deg": Term("slope at the clear aperture's rim", _scaled(180 / math.pi, objectives.edge_slope)),
    "least_radius_mm": Term("least radius of curvature of a lens's surface", objectives.surface_radius),
}

# As they are in every process, whatever a caller puts into the table.
_OURS = dict(TERMS)

_UNITS = {"um": "um", "mm": "mm", "deg": "degrees", "percent": "%", "waves": "waves"}


def check_term(name: str) -> None:
    """Raise `ValueError` unless `name` is a registered term; load it from an entry point if needed.

    An installed package registers its terms as entry points of the group `gs_jax.terms`, whose names are those of the
    terms and whose objects are `Term`s.
    """
    if name not in TERMS:
        TERMS.update({point.name: point.load() for point in entry_points(group=_GROUP, name=name)})
    if name not in TERMS:
        near = difflib.get_close_matches(name, TERMS, n=3) or list(TERMS)[:3]
        others = len(TERMS) - len(near)
        own = "; a study imports no code, --terms FILE.py adds terms of your own" if ":" in name else ""
        raise ValueError(f"name must be {', '.join(near)} or one of {others} others, got {short_repr(name)}{own}")


def add_terms(path: PathLike) -> None:
    """Run a Python file and add its terms to `TERMS`.

    The file defines a dictionary `TERMS` from names to `Term`s. Workers of a search get the terms, not the file.

    Raises `InputError` if the file cannot be read or run, has no such dictionary, or redefines a term.
    """
    check_suffix(path, (".py",))
    source = hashlib.sha256(check_input(path).read_bytes()).hexdigest()
    try:
        own = runpy.run_path(str(path), run_name="gs_jax_terms").get("TERMS")
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path}: cannot be run: {reason.rstrip('.')}.") from error
    terms = own.items() if isinstance(own, dict) else ()
    if not terms or not all(isinstance(name, str) and isinstance(term, Term) for name, term in terms):
        raise input_error("TERMS", "a dictionary from names to `gs_jax.codesign.terms.Term`", short_repr(own), path)
    if twice := [name for name, term in terms if name in TERMS and TERMS[name].source != source]:
        raise input_error("TERMS", "names that are no terms yet", twice[0], path)
    TERMS.update({name: term._replace(source=source) for name, term in terms})


def with_terms(build: Callable[[], Built], names: Iterable[str]) -> Callable[[], Built]:
    """`build` for another process, whose `TERMS` then are of these names what they are here: its own go with it."""
    terms = {name: None if TERMS[name] is _OURS.get(name) else TERMS[name] for name in names}
    return partial(_built_with, build, terms)


def _built_with(build, terms):
    TERMS.update({name: term or _OURS[name] for name, term in terms.items()})
    return build()


def unit_of(name: str) -> str:
    """The unit that a term's name ends in, as people write it; empty for a number without one."""
    return _UNITS.get(name.rpartition("_")[2], "")
