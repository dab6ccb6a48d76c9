"""What is wrong with a design, in words: its datasheet against what its formulas assume."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import objectives
from ..geometry import Imager
from ..objectives.conditions import Conditions
from ..objectives.quantities import third_order_wavefront
from ..optics import aberrations, theory
from ..optics.raytrace import to_numpy, trace_lenslet
from .datasheets import circle_of_confusion_of, parts_of
from .design import Design

# Spots so many times wider than promised are said to be.
_FAR = 2.0
# Depths at which the brightest core is looked for, rays across the pupil, and how bright the others are at least.
_DEPTHS, _RAYS, _NEARLY = 300, 4000, 0.5
# Share of the plate without lenses that needs no mask.
_LEAST_BETWEEN = 0.005
# Eq. 9 holds below this RMS wavefront error, in waves.
_STREHL_DOMAIN = 0.1


def findings(design: Design, sheet: dict[str, Any], *, circle_of_confusion: float | None = None) -> list[str]:
    """What violates what, in short sentences; empty if nothing does.

    `design`, `sheet`: a microscope and its datasheet. `circle_of_confusion`: as for `datasheet`.

    Raises `InputError` as `datasheet`.
    """
    parts = parts_of(design, sheet["depth_mm"], circle_of_confusion=circle_of_confusion)
    focus = _focus(design, sheet, parts, circle_of_confusion_of(design, circle_of_confusion))
    # What a wavefront error does is said of lenses that are alike: each type has its own.
    strehl = _strehl(design, sheet, *parts[0]) if len(parts) == 1 else []
    checks = (_rays(sheet), focus, strehl, _pixels(design, sheet))
    return [sentence for check in (*checks, _pitch(sheet), _occupancy(sheet), _mask(sheet)) for sentence in check]


def _rays(sheet: dict[str, Any]) -> list[str]:
    """What exact rays say where it is far from what the formulas promise."""
    wide, promised = np.array(sheet["spot_width_um"]), np.array(sheet["lateral_resolution_um"])
    if not (wide > _FAR * promised).any():
        return []
    core, half, rms = (_span(np.array(sheet[f"{key}_um"])) for key in ("fwhm", "half_light_radius", "rms_width"))
    return [
        f"Eq. 5 promises {_span(promised)} um. By diffraction a point's image is {core} um wide at half its height on "
        f"the axis; by exact rays half of its light is within a radius of {half} um, and the RMS width is {rms} um: "
        "light far outside the core is a background."
    ]


def _sharp_cores(imager: Imager, at: Conditions) -> list[str]:
    """Where most light falls into a core three pixels wide, on the axis."""
    depths, within = map(np.asarray, _light_within(imager, at, 1.5 * imager.sensor.pixel_pitch))
    best = within.argmax()
    if best in (0, _DEPTHS - 1):
        return []
    near, far = (float(depths[i]) for i in np.flatnonzero(within >= _NEARLY * within[best])[[0, -1]])
    near = max(near, float(imager.sample_surface))
    return [f"By exact rays cores of spots hold half of the most light, or more, at {near:.3g} to {far:.3g} mm."]


@eqx.filter_jit
def _light_within(imager, at, radius):
    """Depths, and of a point there on a lens's axis the light within a radius, by exact rays, relative."""
    depths = jnp.geomspace(at.depths[0] / 2, 2 * at.depths[-1], _DEPTHS)
    radii = jnp.asarray((np.arange(_RAYS) + 0.5) / _RAYS, depths.dtype) * objectives.clear_diameter(imager, at) / 2
    pupil = jnp.stack([radii, jnp.zeros_like(radii)], -1)
    rays = jax.vmap(lambda depth: trace_lenslet(imager, depth, pupil))(depths)
    return depths, jnp.sum(jnp.where(rays.valid & (jnp.abs(rays.landing[..., 0]) < radius), radii, 0), -1)


def _focus(
    design: Design, sheet: dict[str, Any], parts: list[tuple[Imager, Conditions]], circle_of_confusion: float
) -> list[str]:
    v, blurs = design.imaging.sensor_distance_mm, sheet["blur_um"]
    outside = [i for i, blur in enumerate(blurs) if blur > circle_of_confusion * 1000]
    if not outside:
        return []
    limit = f"the circle of confusion, {_length(circle_of_confusion)}"
    return [
        *(_blurred(v, sheet, i) for i in sorted({outside[0], outside[-1]})),
        f"{len(outside)} of {len(blurs)} depths are out of focus: blurred by more than {limit}.",
        *(
            _of_type(imager, parts, sentence)
            for imager, at in parts
            for sentence in (_sharp_range(design, imager, at), *_sharp_cores(imager, at))
        ),
    ]


def _of_type(imager: Imager, parts: list[tuple[Imager, Conditions]], sentence: str) -> str:
    """Name the lens type in a sentence, where there are several."""
    if len(parts) == 1:
        return sentence
    return f"Lenses of f = {float(imager.array.focal_length):.4g} mm: {sentence[:1].lower()}{sentence[1:]}"


def _blurred(v: float, sheet: dict[str, Any], i: int) -> str:
    depth, image, blur = sheet["depth_mm"][i], sheet["focus_distance_mm"][i], sheet["blur_um"][i] / 1000
    patch = f"blur {_length(blur)} on the sensor, {_length(blur / sheet['magnification'][i])} in the object"
    if image is None:
        return f"At {depth:g} mm no real image forms: {patch}."
    side = "behind" if image > v else "before"
    return f"At {depth:g} mm the image forms {_length(abs(image - v))} {side} the sensor: {patch}."


def _sharp_range(design: Design, imager: Imager, at: Conditions) -> str:
    host = to_numpy(imager)
    v, f, begins = design.imaging.sensor_distance_mm, float(host.array.focal_length), float(host.sample_surface)
    if host.reduced_sensor_distance <= f:
        return f"The sensor at {v:g} mm is not behind the focal plane at {f:.4g} mm: no depth is in focus."
    near, far = map(float, _limits(imager, at))
    near = max(near, begins)
    working = "the working distance is {:g} to {:g} mm".format(*design.imaging.working_distance_mm)
    if far <= begins:
        where = f"before {begins:g} mm, where the object's medium begins," if begins else "within the plate"
        return f"The sensor at {v:g} mm is so far that only points {where} are in focus; {working}."
    return f"In focus by Eqs. 7 and 8, of a thin lens, are {near:.4g} to {far:.4g} mm; {working}."


@eqx.filter_jit
def _limits(imager, at):
    """Nearest and farthest depth in focus."""
    in_focus = imager.depth_of(theory.depth_in_focus(imager.array.focal_length, imager.reduced_sensor_distance))
    focused = dataclasses.replace(at, depths=in_focus[None])
    return objectives.near_limit(imager, focused)[0], objectives.far_limit(imager, focused)[0]


@eqx.filter_jit
def _wavefront(imager, at):
    """RMS error on the axis, waves; the field where the Strehl ratio halves, spherical aberration and balanced, mm."""
    error, pupil = third_order_wavefront(imager, at, jnp.zeros(1, at.depths.dtype)), at.clear_diameter / 2
    v, reduced = imager.reduced_sensor_distance, imager.reduced_depth(at.depths)
    half = aberrations.linear_field_radius(imager.array, pupil, reduced, v, imager.wavelength)
    waves = aberrations.linear_rms(error)[:, 0] / imager.wavelength
    return waves, half, error.spherical[0, 0], aberrations.balanced_rms(error).spherical[0, 0]


def _strehl(design: Design, sheet: dict[str, Any], imager: Imager, at: Conditions) -> list[str]:
    waves, half, spherical, balanced = map(np.asarray, _wavefront(imager, at))
    if waves.max() <= _STREHL_DOMAIN:
        return []
    found = [
        f"The wavefront error on the axis is {_span(waves)} waves RMS, and Eq. 9 holds below about {_STREHL_DOMAIN}: "
        "the Strehl ratios only say that the image is far from diffraction-limited."
    ]
    if design.lens.focal_length_mm is not None:  # an ideal lens: all of it is defocus
        return found
    found.append(
        f"By Eqs. 9 and 10 the Strehl ratio halves {_span(1000 * half)} um beside the axis, "
        f"not at the field radius of {_length(sheet['field_radius_mm'])}."
    )
    paraxial = sheet["focus_distance_mm"]
    host, pupil = to_numpy(imager), float(objectives.clear_diameter(imager, at)) / 2
    if paraxial[0] is not None and balanced > _STREHL_DOMAIN * host.wavelength:
        image = paraxial[0] + float(host.reduced_sensor_distance - host.sensor_distance)
        sharpest = 1 / (1 / image + 2 * float(spherical) / pupil**2)
        found.append(
            "Focus and blur are a thin lens's; spherical aberration draws the sharpest image of "
            f"{sheet['depth_mm'][0]:g} mm toward the lens, by up to {_length(image - sharpest)}."
        )
    return found


def _pixels(design: Design, sheet: dict[str, Any]) -> list[str]:
    pixel = design.sensor.pixel_pitch_um
    spot = design.imaging.wavelength_nm / 2000 / sheet["numerical_aperture"]
    if spot >= pixel:
        return []
    return [f"Pixels limit the lateral resolution: the diffraction spot is {spot:.2g} um, a pixel {pixel:g} um."]


def _pitch(sheet: dict[str, Any]) -> list[str]:
    aperture, f, pitch = sheet["numerical_aperture"], sheet["focal_length_mm"], sheet["pitch_mm"]
    if pitch is None or abs(pitch / (2 * f * aperture) - 1) < 0.05:
        return []
    return [
        f"The numerical aperture of {aperture:.3f} is that of the clear diameter, {2 * f * aperture:.3g} mm; the paper "
        f"takes the pitch, {pitch:.3g} mm, for the diameter, which gives {pitch / (2 * f):.3f}."
    ]


def _occupancy(sheet: dict[str, Any]) -> list[str]:
    worst = int(np.argmax(sheet["occupancy"]))
    depth, occupancy = sheet["depth_mm"][worst], sheet["occupancy"][worst]
    if occupancy <= 1:
        return []
    return [f"At {depth:g} mm the occupancy is {occupancy:.2g}: sub-images of an object that fills the field overlap."]


def _mask(sheet: dict[str, Any]) -> list[str]:
    between = 1 - sheet["coverage"]
    if between < _LEAST_BETWEEN:
        return []
    return [f"{100 * between:.1f} % of the plate is no lens's: an opaque mask must cover it (`gs-jax mask`)."]


def _length(mm: float) -> str:
    return f"{_two_digits(mm)} mm" if mm >= 1 else f"{_two_digits(mm * 1000)} um"


def _span(values: np.ndarray) -> str:
    low, high = _two_digits(float(values.min())), _two_digits(float(values.max()))
    return low if low == high else f"{low} to {high}"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"
