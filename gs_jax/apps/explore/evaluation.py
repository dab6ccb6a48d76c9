"""What a design becomes when its numbers move: compiled once, whatever they are.

A `Bench` is the design that is explored; `knobs_of` are the numbers that may move, and between which ends. All lengths
are mm.
"""

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import ValidationError
from scipy.ndimage import gaussian_filter

from ...base.errors import InputError
from ...codesign.objectives import TERMS
from ...codesign.parameters import Parent, candidate, new_design, parent_of
from ...codesign.study import Study
from ...codesign.targets import SIGNS, assess, evaluate
from ...design.design import Design
from ...design.microscope import Microscope
from ...design.spots import encircled_radius, psf_width
from ...geometry import Imager, chief_ray
from ...io.toml import one_line
from ...lenses import MicrolensArray
from ...optics import aberrations
from ...optics.psf import GOLDEN_ANGLE, diffraction_psf, window_fraction
from ...optics.raytrace import unit_rays

# Depths of the datasheet, pixels of a spot's window, and samples in a pixel at most.
_DEPTHS, SIZE, _MOST_SAMPLES = 7, 49, 4
# Where spots are shown: shares of the depth range, and of the field radius.
SPOT_DEPTHS, SPOT_FIELDS = (0.0, 0.5, 1.0), (0.0, 1.0)
# Rays of a spot, the share of them that says how wide it is, and pixels over which those of a wide one are spread.
_RAYS, _NEARLY_ALL, _SMOOTH = 2**15, 0.98, 1.0
# Terms that need the field radius before they are compiled, or random scenes: `gs-jax optimize` judges these.
_NOT_LIVE = frozenset(name for name, term in TERMS.items() if term.random) | {"lens_shortage"}
# What the paper's formulas assume, as `gs_jax.design.problems` has it: spots as wide as promised, a plate of lenses.
_FAR, _LEAST_BETWEEN = 2.0, 0.005

Values = dict[str, float]


class Knob(NamedTuple):
    """A number that may move: its name in words, its ends, and where it began."""

    title: str
    low: float
    high: float
    start: float


class Bench(NamedTuple):
    """A design that is explored, as what is compiled takes it; the terms of a study, and how fine spots are."""

    design: Design
    parent: Parent
    study: Study | None
    samples: int

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the study's terms that can be judged live."""
        return () if self.study is None else tuple(t.name for t in self.study.terms if t.name not in _NOT_LIVE)


def bench_of(design: Design, study: Study | None = None) -> Bench:
    """A design, and what is wanted of it; `InputError` if its lenses differ, which have no one radius to move."""
    imager = design.imager()
    imager.array.check_alike()
    confusion = None if study is None or study.confusion_um is None else study.confusion_um / 1000
    parent = parent_of(design, depth_count=_DEPTHS, confusion=confusion)
    # What of a spot falls outside of `samples / s` windows is folded back (`diffraction_psf`).
    lens = float(imager.array.aperture_diameter)
    s = lens * imager.sensor.pixel_pitch / (float(imager.wavelength) * float(imager.reduced_sensor_distance))
    return Bench(design, parent, study, int(np.clip(math.ceil(1.5 * s), 2, _MOST_SAMPLES)))


def knobs_of(design: Design) -> dict[str, Knob]:
    """What may move; an ideal lens has no curvature."""
    imaging, lens = design.imaging, design.lens
    (near, far), pitch = imaging.working_distance_mm, _pitch(design)
    made = {
        "sensor_distance_mm": ("sensor distance v", 0.6, 1.5, imaging.sensor_distance_mm),
        "radius_of_curvature_mm": ("radius of curvature R", 0.5, 2.0, lens.radius_of_curvature_mm),
        "aperture_diameter_mm": ("aperture D", 0.15, 1.5, lens.aperture_diameter_mm),
        "pitch_mm": ("pitch", 0.6, 1.8, pitch),
        "near_mm": ("nearest depth", 0.4, 1.6, near),
        "far_mm": ("farthest depth", 0.6, 2.0, far),
        "field_radius_mm": ("field radius", 0.3, 2.0, imaging.field_radius_mm),
    }
    if lens.focal_length_mm is not None:
        made.pop("radius_of_curvature_mm")
    if len(design.array.centers_mm) < 2:
        made.pop("pitch_mm")
    return {name: Knob(title, low * at, high * at, at) for name, (title, low, high, at) in made.items()}


def _pitch(design: Design) -> float:
    return float(parent_of(design, depth_count=2).pitch)


def checked_values(design: Design, values: Values) -> Values:
    """All knobs, those that are not said where they began.

    Raises
    ------
    InputError
        If there is no such knob, a value is beyond its ends, or the nearest depth is not below the farthest.
    """
    knobs = knobs_of(design)
    if unknown := [name for name in values if name not in knobs]:
        raise InputError(f"found {unknown[0]!r}, allowed: {', '.join(knobs)}.")
    whole = {name: float(values.get(name, knob.start)) for name, knob in knobs.items()}
    for name, value in whole.items():
        low, high = knobs[name].low, knobs[name].high
        if not low * (1 - 1e-9) <= value <= high * (1 + 1e-9):
            raise InputError(f"{knobs[name].title}: found {value:g} mm, allowed: {low:.4g} to {high:.4g} mm.")
    if not whole["near_mm"] < whole["far_mm"]:
        raise InputError(f"nearest depth: found {whole['near_mm']:g} mm, allowed: below {whole['far_mm']:g} mm.")
    return whole


class Judged(NamedTuple):
    """What a design does, by depth; `spots` are `[depth, field, row, column]`, `terms` those of the study.

    The sum of a spot is the share of the light through the lens that falls into its window.
    """

    depths: Float[np.ndarray, " depth"]
    numbers: dict[str, Float[np.ndarray, " depth"]]
    scalars: dict[str, Float[np.ndarray, ""]]
    terms: dict[str, Float[np.ndarray, " _"]]
    spots: Float[np.ndarray, "place field row column"]


def judge(bench: Bench, values: Values) -> Judged:
    """What the design of these values does; `checked_values` has looked at them."""
    traced = {name: jnp.asarray(value) for name, value in values.items()}
    found = _judged(bench.parent, traced, bench.terms)
    depths, numbers, scalars, terms = jax.tree.map(lambda x: np.asarray(x, np.float64), found)
    near, far, field = (values[name] for name in ("near_mm", "far_mm", "field_radius_mm"))
    unit, radius = unit_of(bench, values), float(scalars["clear_diameter_mm"]) / 2
    one = lambda depth, height: spot_of(bench, unit, depth, height, radius)
    spots = [[one(near + z * (far - near), h * field) for h in SPOT_FIELDS] for z in SPOT_DEPTHS]
    return Judged(depths, numbers, scalars, terms, np.array(spots))


def unit_of(bench: Bench, values: Values) -> Imager:
    """One lens of these values. What does not change its spots is as it was: it would compile anew."""
    made, own = imager_of(bench, values), bench.design
    array = dataclasses.replace(made.array.lens(0), size=own.array.size_mm)
    return dataclasses.replace(made, array=array, field_radius=own.imaging.field_radius_mm)


def spot_of(bench: Bench, unit: Imager, depth: float, height: float, radius: float) -> Float[np.ndarray, "row column"]:
    """The spot of a point at a depth and beside the axis, through a clear aperture of this radius, mm.

    By diffraction; where it is so wide that samples of the pupil do not tell it, by rays.
    """
    kind, pixel = unit.sensor_distance.dtype, unit.sensor.pixel_pitch
    place = [jnp.asarray(x, kind) for x in (depth, height, radius)]
    beside, valid = (np.asarray(x) for x in _landing(unit, *place))
    # What is farther than this is folded back (`diffraction_psf`).
    s = 2 * radius * pixel / (float(unit.wavelength) * float(unit.reduced_sensor_distance))
    within = pixel * SIZE * bench.samples / s / 2
    if valid.any() and np.quantile(np.abs(beside[valid]).max(1), _NEARLY_ALL) < within:
        return np.asarray(_diffracted(unit, *place, bench.samples), float)
    edges = pixel * (np.arange(SIZE + 1) - SIZE / 2)
    counted = np.histogram2d(beside[valid, 1], beside[valid, 0], [edges, edges])[0] / max(valid.sum(), 1)
    # A pixel has few rays.
    return gaussian_filter(counted, _SMOOTH)


@jax.jit
def _landing(unit: Imager, depth: Array, height: Array, radius: Array):
    """Where rays meet the sensor, from the chief ray, and whether they do."""
    order = np.arange(_RAYS) + 0.5
    spiral = np.sqrt(order / _RAYS) * np.stack([np.cos(GOLDEN_ANGLE * order), np.sin(GOLDEN_ANGLE * order)])
    field = (height, jnp.zeros_like(height))
    rays = unit_rays(unit, depth, radius * jnp.asarray(spiral.T, radius.dtype), field)
    chief = chief_ray(jnp.zeros(2, radius.dtype), jnp.stack(field), unit.magnification(depth))
    return rays.landing - chief[None], rays.valid


@partial(jax.jit, static_argnums=4)
def _diffracted(unit: Imager, depth: Array, height: Array, radius: Array, samples: int) -> Array:
    given = {"size": SIZE, "field": (height, jnp.zeros_like(height)), "radius": radius, "samples": samples}
    return diffraction_psf(unit, depth, **given) * window_fraction(unit, depth, **given)


def _microscope(parent: Parent, values: dict[str, Array]) -> Microscope:
    near, far, field = (values[name] for name in ("near_mm", "far_mm", "field_radius_mm"))
    own = {name: value for name, value in values.items() if name not in ("near_mm", "far_mm", "field_radius_mm")}
    here = eqx.tree_at(lambda p: p.middle, parent, (near + far) / 2)
    made = candidate(here, own | {"depth_span_mm": far - near})
    return dataclasses.replace(made, field_radius=field)


@eqx.filter_jit
def _judged(parent: Parent, values: dict[str, Array], terms: tuple[str, ...]):
    m = _microscope(parent, values)
    axis = aberrations.linear_rms(m.wavefront(jnp.zeros(1)))[:, 0]
    numbers = {
        "magnification": m.magnification,
        "lateral_resolution_um": 1000 * m.lateral_resolution,
        "axial_resolution_um": 1000 * m.axial_resolution,
        "spot_width_um": 1000 * psf_width(m),
        "spot_radius_um": 1000 * encircled_radius(m),
        "blur_um": 1000 * m.blur,
        "depth_of_field_mm": m.depth_of_field,
        "strehl_on_axis": aberrations.strehl(axis, m.imager.wavelength),
        "occupancy": m.occupancy,
    }
    scalars = {
        "focal_length_mm": m.focal_length,
        "f_number": m.f_number,
        "numerical_aperture": m.numerical_aperture,
        "lenses_per_point": m.lenses_per_point,
        "coverage": m.coverage,
        "clear_diameter_mm": m.clear_diameter,
    }
    key = jax.random.key(0)
    return m.depths, numbers, scalars, {name: evaluate(name, m, key) for name in terms}


def violations(bench: Bench, values: Values, found: Judged) -> list[str]:
    """What violates a target of the study, and what the formulas assume, in words."""
    said, numbers = [], found.numbers
    if not all(np.isfinite(value).all() for value in (*numbers.values(), *found.scalars.values())):
        said.append("Some numbers are none: rays do not get through this lens.")
    sphere = bench.design.lens.conic_constant == 0 and not bench.design.lens.aspheric_terms
    radius = values.get("radius_of_curvature_mm", math.inf)
    if sphere and values["aperture_diameter_mm"] > 2 * radius:
        said.append(f"A lens {values['aperture_diameter_mm']:.3g} mm wide is none: a sphere has {2 * radius:.3g} mm.")
    for table in () if bench.study is None else bench.study.terms:
        if table.name in found.terms:
            row = assess(table, found.terms[table.name])
            if row.met is False:
                span = " to ".join(dict.fromkeys(f"{end:.3g}" for end in (row.low, row.high)))
                wanted = f"{SIGNS[table.kind]} {table.target:g}"
                said.append(f"Target missed: {TERMS[table.name].meaning} ({table.name}) is {span}, wanted {wanted}.")
    confusion = 1000 * float(bench.parent.confusion)
    out = numbers["blur_um"] > confusion
    if out.any():
        worst = float(numbers["blur_um"].max())
        said.append(
            f"{out.sum()} of {len(out)} depths are out of focus: a thin lens blurs a point over up to {worst:.3g} um "
            f"of the sensor, more than the circle of confusion, {confusion:.3g} um."
        )
    wide, promised = numbers["spot_width_um"], numbers["lateral_resolution_um"]
    if (wide > _FAR * promised).any():
        said.append(
            f"By exact rays spots are up to {(wide / promised).max():.3g} times as wide as Eq. 5 promises: "
            f"{wide.max():.3g} um of the object."
        )
    if (most := float(numbers["occupancy"].max())) > 1:
        said.append(f"The occupancy is up to {most:.3g}: sub-images of an object that fills the field overlap.")
    if (between := 1 - float(found.scalars["coverage"])) > _LEAST_BETWEEN:
        said.append(f"{100 * between:.3g} % of the plate is no lens's: it needs a mask.")
    return said


def imager_of(bench: Bench, values: Values) -> Imager:
    """The geometry of these values."""
    design, own = bench.design, bench.design.imager()
    scale = values.get("pitch_mm", float(bench.parent.pitch)) / float(bench.parent.pitch)
    x, y = design.array.size_mm
    array = MicrolensArray(
        scale * np.array(design.array.centers_mm),
        radius_of_curvature=values.get("radius_of_curvature_mm", design.lens.radius_of_curvature_mm),
        refractive_index=design.lens.refractive_index,
        aperture_diameter=values["aperture_diameter_mm"],
        substrate_thickness=design.array.substrate_thickness_mm,
        thin_lens_focal_length=design.lens.focal_length_mm,
        size=(scale * x, scale * y),
        orientation=design.lens.orientation,
        conic_constant=design.lens.conic_constant,
        aspheric_terms=design.lens.aspheric_terms,
    )
    distance, field = values["sensor_distance_mm"], values["field_radius_mm"]
    place = {"rotation": own.rotation, "shift": own.shift, "wavelength": own.wavelength, "tilt": own.tilt}
    return Imager(array, own.sensor, distance, field, **place)


def design_of(bench: Bench, values: Values, provenance: dict[str, Any]) -> Design:
    """The design of these values as a file holds it; `InputError` if they make no microscope."""
    near, far = values["near_mm"], values["far_mm"]
    here = eqx.tree_at(lambda p: p.middle, bench.parent, jnp.asarray((near + far) / 2))
    own = {name: jnp.asarray(value) for name, value in values.items()}
    own = {name: own[name] for name in own if name not in ("near_mm", "far_mm", "field_radius_mm")}
    made = new_design(bench.design, here, own | {"depth_span_mm": jnp.asarray(far - near)}).model_dump()
    made["imaging"]["field_radius_mm"] = round(values["field_radius_mm"], 4)
    # The text of numbers as they were chosen, not as single precision has them.
    made["imaging"]["working_distance_mm"] = (round(near, 4), round(far, 4))
    made["provenance"] = provenance
    try:
        return Design.model_validate(made)
    except ValidationError as error:
        raise InputError(f"these values make no microscope: {one_line(error, Design, {})}.") from error
