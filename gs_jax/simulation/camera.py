"""What a camera makes of an image: shot noise, read noise, saturation, whole counts; and back to electrons."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Float32, PRNGKeyArray, UInt8, UInt16

from ..base.arrays import NOT_NEGATIVE, POSITIVE, as_float, check_fields
from ..layouts.cells import Number

# From this mean on, `poisson` uses an expansion. The first term of the sum below is larger than `_summed` needs.
EXPANDED = 16.0
# Rows that are handled at once: what is computed of them stays in the cache.
_ROWS = 16

Counts = UInt8[Array | np.ndarray, "row column"] | UInt16[Array | np.ndarray, "row column"]


class Camera(eqx.Module):
    """What turns electrons into counts.

    *Compiled.*

    Parameters
    ----------
    gain
        Electrons per count.
    offset
        Counts of a pixel without light or noise.
    read_noise
        Standard deviation, electrons.
    full_well
        The most electrons that a pixel holds. By default no limit: the converter saturates first.
    bits
        Of the converter, 1 to 16: counts end at `2**bits - 1`.

    Raises
    ------
    ValueError
        If a number is out of range (values that JAX traces are not looked at).

    Examples
    --------
    >>> import gs_jax as gs
    >>> camera = gs.Camera(gain=2.5, offset=100.0, read_noise=1.6, full_well=10_000.0, bits=12)
    """

    gain: Float[Array, ""] = eqx.field(converter=as_float, default=10.0)
    offset: Float[Array, ""] = eqx.field(converter=as_float, default=16.0)
    read_noise: Float[Array, ""] = eqx.field(converter=as_float, default=2.0)
    full_well: Float[Array, ""] = eqx.field(converter=as_float, default=math.inf)
    bits: int = eqx.field(static=True, default=16)

    def __check_init__(self):
        well = ("positive", lambda x: x > 0)
        check_fields(self, gain=POSITIVE, offset=NOT_NEGATIVE, read_noise=NOT_NEGATIVE, full_well=well)
        if not 1 <= self.bits <= 16:
            raise ValueError(f"`bits` must be 1 to 16, got {self.bits}.")


def expose(
    image: Float[Array | np.ndarray, "row column"],
    camera: Camera,
    key: PRNGKeyArray,
    *,
    peak_electrons: Number | Float[Array, ""],
) -> UInt8[Array, "row column"] | UInt16[Array, "row column"]:
    """The counts of one exposure.

    *Compiled.*

    The image is scaled, Poisson noise drawn, the well filled at most, Gaussian read noise added, and the sum
    divided by the gain, put on the offset, rounded and clipped to the converter's range. Each row has its own
    key, and a few rows are handled at a time: beside the image and the counts it needs little memory.

    Parameters
    ----------
    image
        Linear intensity in any unit, finite and not negative.
    camera
        What it is taken with.
    key
        Of `jax.random`; the same key gives the same noise.
    peak_electrons
        Mean number of electrons in the brightest pixel. An image without light stays without.

    Returns
    -------
    Array
        uint8 for a camera of up to 8 bits, else uint16.

    Raises
    ------
    ValueError
        If the image is negative somewhere, NaN or infinite, or `peak_electrons` is not positive and finite
        (values that JAX traces are not looked at).

    Examples
    --------
    >>> import gs_jax as gs, jax, numpy as np
    >>> counts = gs.expose(np.eye(64), gs.Camera(), jax.random.key(0), peak_electrons=10_000)
    >>> print(counts.dtype, round(float(np.median(counts))))  # dark pixels: the offset
    uint16 16
    """
    image = jnp.asarray(image)
    peak = jnp.asarray(peak_electrons, image.dtype)
    _check("peak_electrons", peak, (peak > 0) & jnp.isfinite(peak), "positive and finite")
    # Not `min` and `max`: they pass over a NaN on some devices.
    wrong = ~((image >= 0) & (image < jnp.inf))
    _check("image", f"{wrong.sum()} pixels that are not", ~wrong.any(), "finite and not negative")
    return _expose(image, camera, key, peak)


@jax.jit
def _expose(image, camera, key, peak):
    camera = jax.tree.map(lambda leaf: leaf.astype(image.dtype), camera)
    brightest = image.max()
    scale = jnp.where(brightest > 0, peak / jnp.where(brightest > 0, brightest, 1), 0)

    def row(pixels, shot, read):
        charge = jnp.minimum(poisson(shot, scale * pixels), camera.full_well)
        charge += camera.read_noise * jax.random.normal(read, pixels.shape, pixels.dtype)
        counts = jnp.round(charge / camera.gain + camera.offset)
        return jnp.clip(counts, 0, 2**camera.bits - 1).astype(jnp.uint8 if camera.bits <= 8 else jnp.uint16)

    keys = jax.random.split(key, (2, image.shape[0]))
    return lax.map(lambda rows: row(*rows), (image, *keys), batch_size=_ROWS)


def electrons(counts: Counts, camera: Camera) -> Float32[Array, "row column"]:
    """Electrons of counts, linear: `gain (counts - offset)`.

    The inverse of `expose` but for its noise and rounding; pixels in the dark come out on both sides of zero.
    """
    gain, offset = camera.gain.astype(jnp.float32), camera.offset.astype(jnp.float32)
    return gain * (jnp.asarray(counts).astype(jnp.float32) - offset)


def poisson(key: PRNGKeyArray, mean: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Poisson variates as whole floats, many times faster on a CPU than `jax.random.poisson`.

    One uniform variate `u` a number, and the inverse of the distribution at it. Below a mean `m` of 16 the
    probabilities are added up: exact. Above, with the normal quantile `w` of `u`, it is the expansion

        floor(m + sqrt(m) w + (w^2 + 2) / 6 - (w^3 + 2 w) / (72 sqrt(m)))

    (the first terms of Giles, ACM Trans. Math. Softw. 42, 7, 2016). It is at its worst at `m = 16`: cumulated
    probabilities are off by up to 1.3e-4, the mean by less than 1e-6, the variance by 2.4e-5 of itself. In float32
    `u` has steps of 1e-7, and what is rarer than this does not occur.

    Parameters
    ----------
    key
        Of `jax.random`.
    mean
        Finite and not negative; in float32 below 1.6e7, where whole numbers end.
    """
    # Without the ends, -1 and 1, where w would be infinite.
    v = jax.random.uniform(key, mean.shape, mean.dtype, minval=jnp.nextafter(jnp.array(-1, mean.dtype), 0))
    w, root = math.sqrt(2) * lax.erf_inv(v), jnp.sqrt(jnp.maximum(mean, EXPANDED))
    many = jnp.floor(mean + root * w + (w**2 + 2) / 6 - (w**3 + 2 * w) / (72 * root))
    return jnp.where(mean < EXPANDED, _summed((v + 1) / 2, jnp.where(mean < EXPANDED, mean, 0)), many)


def _summed(u, mean):
    """The smallest number whose cumulated probability reaches `u`."""
    # A term below the rounding of a sum near 1 adds nothing: without this bound some searches would not end.
    least = jnp.finfo(u.dtype).eps / 4

    def searching(state):
        _, _, term, total = state
        return (u > total) & (term > least)

    def step(state):
        index, count, term, total = state
        term = term * mean / index
        go_on = searching(state)
        return index + 1, jnp.where(go_on, count + 1, count), term, jnp.where(go_on, total + term, total)

    first = jnp.exp(-mean)
    start = (jnp.ones((), u.dtype), jnp.zeros_like(u), first, first)
    return lax.while_loop(lambda state: searching(state).any(), step, start)[1]


def _check(name: str, value, ok: Bool[Array, ""], allowed: str):
    if not isinstance(ok, Tracer) and not ok:
        raise ValueError(f"`{name}` must be {allowed}, got {value}.")
