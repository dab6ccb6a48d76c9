"""What no array exceeds: a bound on linear estimates of volumes by the plate, the light and the depths alone.

Whatever the lenses are, an image is a sum over the rays that cross the plate, and each ray ends in at most one pixel.
A linear estimate from an image is thus one from the rays, and the best of these, from a record of each ray's place and
direction with its own shot noise, has the least error. For the scenes of `gs_jax.codesign.linear_error`, planes with
the spectra `S_k(v)` and the mean brightness `m`, a record of the rays at a point `r` of the plate is a view by a lens
without blur, losses, overlap or read noise. In the sum over the plate

    J_kl = integral dA E(r) / (K m n^2 z_k z_l) exp(2 pi i v . r (M_k - M_l))

for `K` planes in a medium of index `n`, with the light `E` that falls off with the cubed cosine, and the reduced depths
`z_k`; lenses only scale all `M_k = v' / z_k`. The relative error of plane `k` is the diagonal of `(1 + S^(1/2) J
S^(1/2))^-1`. For many planes it is the share of frequencies outside the cone that the plate's angle measures (Fourier
slice theorem); for one plane it is Wiener's error with all light of the plate's solid angle.

That holds for rays: diffraction, like the pixels, only blurs their images further in the models of this package. It
bounds linear estimates, and with normal noise all estimates of normal scenes. It does not bound what solvers with a
positivity constraint, or a trained network, find in sparse scenes.

Views of a design count as in `volume_error` but for their light: here a lens has the same light, share of the sensor
and angle for all depths, their means. Otherwise such differences would tell planes apart where no lens can.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..base.arrays import safe_sqrt
from ..base.errors import InputError
from ..microscope.geometry import Imager
from ..objectives.conditions import Conditions, Depths, as_conditions, finite_plate
from .linear_error import (
    EMITTER_DISTANCE,
    EMITTER_SIDE,
    FILL,
    Scene,
    View,
    directions,
    images,
    noise_density,
    plate_positions,
    scene_of,
    views_and_spots,
)

# Strips of the plate across a direction: several for each of the 230 periods of voxels of 40 um between planes at 15
# and 30 mm under a plate of 20 mm, more where voxels are finer, up to a limit; and nodes along a strip.
_STRIPS, _MOST, _NODES = 1024, 2**16, 8
# Exposures of a datasheet: dim, usual, bright.
EXPOSURES = (1e3, 1e4, 1e5)


class VolumeBound(NamedTuple):
    """Gains over an empty volume, dB: `design` by its own lenses, and `most` that no lenses on its plate exceed."""

    design: Float[Array, ""]
    most: Float[Array, ""]


def volume_bound(imager: Imager, depths: Depths) -> VolumeBound:
    """What a linear estimate of a volume gains over an empty one, and a bound for any lenses on the same plate.

    *Compiled.*

    Scenes are random planes at the depths, as wide as the plate, independent of each other, of objects with edges that
    fill 3 %, on voxels of `Conditions.detail`, 40 um by default. The bound depends on the size of the plate, the
    depths, the object's medium, the voxels and the exposure. Each ray that crosses the plate ends in at most one pixel,
    so no linear estimate from an image is better than the best one from all rays, each known by its place and
    direction, with shot noise. Losses, overlap and read noise are left out, and the number of pixels. Estimates with a
    positivity constraint may exceed it for sparse scenes.

    Parameters
    ----------
    imager
        Lenses of any number of types on a plate with a size.
    depths
        Of the planes from the array's front, `(depth,)`, mm, or `Conditions`, which have an exposure and voxels, too.
        The more planes there are between the same depths, the lower is the bound.

    Returns
    -------
    VolumeBound
        Both gains in dB, `-10 log10` of the error's power over the scene's, the mean over the depths.

    Raises
    ------
    ValueError
        If the plate has no size, or voxels are much finer than the parallax of the depths under the plate.

    Examples
    --------
    >>> from gs_jax.codesign.bound import volume_bound
    >>> bound = volume_bound(gs.geomscope().imager(), np.linspace(18, 23, 7))
    >>> print(f"{bound.design:.0f} of {bound.most:.0f} dB")
    19 of 28 dB
    """
    at = as_conditions(imager, depths)
    return _bounds(imager, at, _strip_count(imager, at))


def _strip_count(imager: Imager, at: Conditions) -> int:
    """Strips of the plate, four or more for each period of the finest detail; raises `InputError` if too many."""
    magnification = np.asarray(imager.magnification(at.depths))
    parallax = float(np.ptp(magnification) / magnification.mean() * np.linalg.norm(np.asarray(finite_plate(imager))))
    strips = _STRIPS
    while 2 * strips * float(at.detail) < 4 * parallax:
        strips *= 2
    if strips > _MOST:
        given, least = (f"{1000 * length:.3g} um" for length in (float(at.detail), 2 * parallax / _MOST))
        raise InputError(f"The bound needs voxels of at least {least} for this plate and these depths, got {given}.")
    return strips


def _bounds(imager, at, strips) -> VolumeBound:
    return VolumeBound(_gain(_lost_by_design(imager, at)), _gain(lost_by_any(imager, at, strips)))


def bound_sheet(imager: Imager, depths: Depths) -> dict[str, Any]:
    """`volume_bound` at three exposures, as numbers for a datasheet; raises what it does."""
    at = as_conditions(imager, depths)
    gains = _at_exposures(imager, at, jnp.asarray(EXPOSURES, at.depths.dtype), _strip_count(imager, at))
    sheet = {"detail_um": round(1000 * float(at.detail), 3), "exposure": list(EXPOSURES)}
    return sheet | {"design_db": gains.design.tolist(), "most_db": gains.most.tolist()}


@eqx.filter_jit
def _at_exposures(imager, at, exposures, strips) -> VolumeBound:
    return jax.vmap(lambda exposure: _bounds(imager, dataclasses.replace(at, exposure=exposure), strips))(exposures)


def format_bound(sheet: dict[str, Any], planes: int) -> str:
    """A sentence about a design and its bound."""
    own, most = sheet["design_db"], sheet["most_db"]
    shares = _listed([100 * gain / best for gain, best in zip(own, most, strict=True)], "{:.0f}")
    return (
        f"at exposures of {_listed(sheet['exposure'], '{:g}')} the best linear estimate of scenes of {planes} planes "
        f"of voxels of {sheet['detail_um']:g} um gains {_listed(own, '{:.1f}')} dB over an empty volume, by any array "
        f"of this size, light and depth at most {_listed(most, '{:.1f}')}: the design has {shares} % of that"
    )


def _listed(values: Sequence[float], form: str) -> str:
    return " / ".join(map(form.format, values))


def _gain(lost):
    return -10 * jnp.log10(jnp.mean(lost))


@eqx.filter_jit
def _lost_by_design(imager: Imager, at: Conditions) -> Float[Array, " depth"]:
    scene = scene_of(imager, at)
    views, spots = views_and_spots(imager, at, imager.on_plate(plate_positions(imager)), scene)
    views = _alike_at_all_depths(views, imager.reduced_depth(at.depths))

    def at_position(position):
        amplitude, turns = images(imager, at, scene, spots, *position)
        return _unexplained(scene, amplitude[None], turns)

    return jnp.mean(jax.lax.map(at_position, (views, noise_density(imager, at, views))), 0)


def _alike_at_all_depths(views: View, reduced_depth: Float[Array, " depth"]) -> View:
    """Views with the mean light over the squared distance, share of the sensor and angle of all depths."""

    def mean(values):
        return jnp.broadcast_to(jnp.mean(values, 2, keepdims=True), values.shape)

    square = reduced_depth[None, None] ** 2
    light, on_sensor, angles = mean(views.electrons * square) / square, mean(views.on_sensor), mean(views.angles)
    return views._replace(electrons=light, on_sensor=on_sensor, angles=angles)


@eqx.filter_jit
def lost_by_any(imager: Imager, at: Conditions, count: int = _STRIPS) -> Float[Array, " depth"]:
    """Share of each plane's power that every linear estimate leaves unexplained, whatever lenses are on the plate.

    `count`: of the strips into which the plate is divided.
    """
    scene, away = scene_of(imager, at), imager.depth_in_medium(at.depths)
    half, magnification = finite_plate(imager) / 2, imager.magnification(at.depths)
    # Electrons of an emitter per mm^2 of the plate, times the squared distance.
    light = at.exposure.astype(away.dtype) * EMITTER_DISTANCE**2 / (EMITTER_SIDE**2 * FILL * away.size)
    spectrum = safe_sqrt(scene.spectrum) / away[:, None]

    def at_position(position):
        strips = jax.vmap(lambda way: _strips(half, away, position, way, count))(directions(away.dtype).T)
        amplitude = safe_sqrt(light * strips.seen)[..., None, None] * spectrum[None, None]
        return _unexplained(scene, amplitude, 2 * jnp.pi * strips.along[..., None] * magnification[None, None])

    return jnp.mean(jax.lax.map(at_position, plate_positions(imager)), 0)


class Strips(NamedTuple):
    """Strips of a plate: places along the direction across them, mm; integrals of the cubed cosine over them, mm^2."""

    along: Float[Array, "*direction strip"]
    seen: Float[Array, "*direction strip"]


def _strips(half, away, position, way, count) -> Strips:
    """Strips across a direction, which is parallel to no side; the cosine is the mean over the depths."""
    nodes, weights = (jnp.asarray(values, half.dtype) for values in np.polynomial.legendre.leggauss(_NODES))
    reach, across = jnp.abs(way) @ half, jnp.stack([-way[1], way[0]])

    def strip(part):
        along = reach * part
        # Where its middle line enters and leaves the plate.
        middle, extent = -way * along / across, half / jnp.abs(across)
        low, high = jnp.max(middle - extent), jnp.min(middle + extent)
        points = way[None] * along + across[None] * ((low + high) / 2 + (high - low) / 2 * nodes)[:, None]
        offset = jnp.sum((points - position[None]) ** 2, 1)
        cosine = jnp.mean((1 + offset[:, None] / away[None] ** 2) ** -1.5, 1)
        return Strips(along, jnp.maximum(high - low, 0) * reach / count * jnp.sum(weights * cosine))

    return jax.vmap(strip)(jnp.asarray((np.arange(count) + 0.5) / count * 2 - 1, half.dtype))


def _unexplained(scene: Scene, amplitude: Float[Array, "#direction view depth frequency"], turns):
    """Share of each plane's power that the best linear estimate from views leaves unexplained, as `lost_power`.

    By a QR decomposition, as planes that are nearly the same need all digits of single precision.
    """
    planes = jnp.eye(turns.shape[-1], dtype=turns.dtype)

    def at_frequency(frequency, amplitude):
        views = jax.lax.complex(*(amplitude * wave(frequency * turns) for wave in (jnp.cos, jnp.sin)))
        alone = jnp.broadcast_to(planes, (len(views), *planes.shape)).astype(views.dtype)
        triangle = jnp.linalg.qr(jnp.concatenate([views, alone], 1), mode="r")
        inverse = jax.scipy.linalg.solve_triangular(triangle, alone)
        return jnp.mean(jnp.sum(jnp.abs(inverse) ** 2, 2), 0)

    return jnp.sum(jax.vmap(at_frequency, (0, 3), 1)(scene.frequency, amplitude) * scene.share, 1)
