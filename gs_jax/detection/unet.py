"""Background suppression by a U-Net (paper, "Background suppression through a convolutional neural network").

A back-projected stack holds every object again, blurred or as ghosts, in the slices where it is not. A network that
looks at one slice (the paper's) or at several around it (ours) gives back what is in focus there. A volume goes in
and a volume comes out, of the same voxels: nothing is downsampled.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..base.arrays import check_finite
from ..base.errors import InputError, short_repr
from ..io import weights
from ..io.provenance import Provenance
from ..typing import PathLike, Volume
from .background import mirrored

# The networks that come with the package, and what a file of weights may hold at most.
PRETRAINED = ("paper", "multislice")
_MOST_LEVELS, _MOST_WIDTH, _MOST_OFFSET = 8, 4096, 64
# The most voxels of a plane that one call of the network answers for, along each axis: about half a GiB.
_CORE = 1024
# Voxels at each edge that a block's two convolutions make of the zeros beyond it.
_SPOILT = 2


class Block(eqx.Module):
    """Two 3 x 3 convolutions, each with a rectifier."""

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d

    def __init__(self, channels: int, width: int, *, key: PRNGKeyArray):
        one, two = jax.random.split(key)
        self.first = _convolution(channels, width, 3, one)
        self.second = _convolution(width, width, 3, two)

    def __call__(self, x: Float[Array, "channel y x"]) -> Float[Array, "width y x"]:
        return jax.nn.relu(self.second(jax.nn.relu(self.first(x))))


class UNet(eqx.Module):
    """A U-Net (Ronneberger, Fischer, Brox, MICCAI 2015) from some slices of a stack to one.

    Each level has two convolutions and half as many rows and columns as the one above; on the way up a level is
    narrowed, enlarged and put beside what the way down had there.

    Parameters
    ----------
    offsets
        Which slices it sees, counted from the one that it is for: `(0,)` is that slice alone.
    widths
        Channels of each level, the finest first.
    standardized
        The network is meant for volumes less each plane's median, in standard deviations; without it, for volumes over
        their largest value. `suppress` sees to it.
    key
        For the weights at the start (He's normal distribution).

    Raises
    ------
    ValueError
        If `offsets` lacks 0 or `widths` is empty.
    """

    down: tuple[Block, ...]
    narrow: tuple[eqx.nn.Conv2d, ...]
    up: tuple[Block, ...]
    last: eqx.nn.Conv2d
    offsets: tuple[int, ...] = eqx.field(static=True)
    widths: tuple[int, ...] = eqx.field(static=True)
    standardized: bool = eqx.field(static=True)

    def __init__(self, offsets: tuple[int, ...], widths: tuple[int, ...], *, standardized: bool, key: PRNGKeyArray):
        if 0 not in offsets:
            raise ValueError(f"`offsets` must have 0, the slice that is wanted, got {offsets}.")
        if not widths:
            raise ValueError("`widths` must have a level at least, got none.")
        self.offsets, self.widths, self.standardized = offsets, widths, standardized
        pairs = list(zip(widths, widths[1:], strict=False))
        keys = iter(jax.random.split(key, 3 * len(widths)))
        self.down = tuple(Block(a, b, key=next(keys)) for a, b in zip((len(offsets), *widths), widths, strict=False))
        self.narrow = tuple(_convolution(b, a, 1, next(keys)) for a, b in reversed(pairs))
        self.up = tuple(Block(2 * a, a, key=next(keys)) for a, _ in reversed(pairs))
        self.last = _convolution(widths[0], 1, 1, next(keys))

    @property
    def multiple(self) -> int:
        """What rows and columns must be a multiple of."""
        return 2 ** (len(self.widths) - 1)

    @property
    def margin(self) -> int:
        """How far beyond its core, in voxels, a tile reaches that `core` answers for.

        Each of the L levels below the finest needs, on its way down, 2 voxels for its convolutions and twice what the
        level below it needs; the lowest needs 4, as 2 are wanted beyond it on the way up: `6 * 2^L - 2`.
        """
        return 6 * self.multiple - _SPOILT

    def __call__(self, slices: Float[Array, "channel y x"]) -> Float[Array, "y x"]:
        """What is in focus; it may be a little below zero, which `suppress` cuts off."""
        return self._through(slices, 0)

    def core(self, slices: Float[Array, "channel y x"]) -> Float[Array, "y_core x_core"]:
        """The same without `margin` at each edge, where zeros beyond it are seen, and less is computed for it."""
        return _cut(self._through(slices, _SPOILT), _SPOILT)

    def _through(self, slices, spoilt: int):
        """What each block gives loses so many voxels at its edges."""
        x, skipped = slices, []
        for level, block in enumerate(self.down):
            x = _cut(block(x if level == 0 else _halved(x)), spoilt)
            skipped.append(x)
        for narrow, block, same in zip(self.narrow, self.up, reversed(skipped[:-1]), strict=True):
            low = _doubled(narrow(x))
            beside = _cut(same, (same.shape[1] - low.shape[1]) // 2)
            x = _cut(block(jnp.concatenate([beside, low])), spoilt)
        return self.last(x)[0]


def paper_network(key: PRNGKeyArray) -> UNet:
    """The paper's: single slices, five levels of 16 to 256 channels (the widths are those of the authors' code)."""
    return UNet((0,), (16, 32, 64, 128, 256), standardized=False, key=key)


def multislice_network(key: PRNGKeyArray) -> UNet:
    """Ours: a slice and the three on each side of it, so that it sees in which one light is in focus."""
    return UNet((-3, -2, -1, 0, 1, 2, 3), (16, 32, 64, 128), standardized=True, key=key)


def suppress(volume: Float[Array | np.ndarray, "depth y x"], network: UNet | None = None) -> Volume:
    """What of a back-projected volume is in focus, slice by slice; the rest becomes darker or zero.

    *Host.*

    What the network sees is in its own unit (`standardized`), what it gives back in the volume's, above each plane's
    background. The first and last slices are repeated where the network looks beyond them, and planes are mirrored at
    their edges. A plane is handled in tiles that overlap by as much as the network can see: the result does not depend
    on them, and the memory needed beside the two volumes does not grow with the planes.

    Parameters
    ----------
    volume
        Of any size, finite; a volume as `reconstruct` makes it by back-projection.
    network
        From `pretrained`, `read_weights` or training; by default ours, which comes with the package.

    Returns
    -------
    ndarray
        Of the volume's shape, not negative.

    Raises
    ------
    InputError
        If a voxel is not finite.

    Examples
    --------
    >>> import gs_jax as gs, numpy as np
    >>> volume = np.random.default_rng(0).random((3, 64, 64)) + 5.0  # background alone
    >>> clean = gs.suppress(volume)
    >>> clean.shape, bool(clean.min() >= 0)
    ((3, 64, 64), True)
    """
    network = pretrained() if network is None else network
    check_finite("volume", volume, "voxels")
    volume = np.asarray(volume, np.float32)
    result = np.zeros_like(volume)
    if not volume.size:
        return result
    if network.standardized:
        volume, unit = standardized(volume)
    else:
        unit = volume.max()
    if not unit > 0:
        return result
    last = len(volume) - 1
    rows, columns = (_tiles(size, network) for size in volume.shape[1:])
    for depth in range(len(volume)):
        slices = volume[np.clip(depth + np.array(network.offsets), 0, last)]
        for (row, tall), (column, wide) in product(rows, columns):
            tile = slices[:, tall[:, None], wide[None]] / unit
            found = np.asarray(_inner(network, tile))
            place = result[depth, row : row + found.shape[0], column : column + found.shape[1]]
            place[...] = found[: place.shape[0], : place.shape[1]]
    return unit * result


def standardized(volume: Float[np.ndarray, "depth y x"]) -> tuple[Float[np.ndarray, "depth y x"], float]:
    """A volume less the median of each plane, and the standard deviation of what is left."""
    above = volume - np.median(volume, axis=(1, 2), keepdims=True)
    return above, float(np.sqrt(np.mean(np.square(above, dtype=np.float64))))


@eqx.filter_jit
def _inner(network: UNet, tile):
    """The network's answer without the margin, where it would see the tile's edges."""
    return jnp.maximum(network.core(jnp.asarray(tile, network.last.weight.dtype)), 0)


def _tiles(size: int, network: UNet) -> list[tuple[int, np.ndarray]]:
    """Along an axis: where each tile's core starts, and the voxels that core and margins hold, mirrored at the ends."""
    count = -(-size // _CORE)
    core = -(-size // (count * network.multiple)) * network.multiple
    offsets = np.arange(-network.margin, core + network.margin)
    return [(start, mirrored(start + offsets, size)) for start in range(0, size, core)]


def write_weights(path: PathLike, network: UNet, provenance: Provenance | None = None) -> None:
    """Writes a network as `.npz`; see `gs_jax.io.weights`."""
    about = {"offsets": network.offsets, "widths": network.widths, "standardized": network.standardized}
    weights.write_weights(path, network, about, provenance)


def read_weights(path: PathLike) -> UNet:
    """The network in a file of `write_weights`, in float32. Nothing in the file is ever executed.

    Raises
    ------
    InputError
        If the file cannot be read, or holds no network, or not the arrays of its network, finite.
    """
    return weights.read_weights(path, _skeleton)


def pretrained(name: str = "multislice") -> UNet:
    """A network that comes with the package: `"paper"` or `"multislice"`, ours. Its model card says how it was made.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    if name not in PRETRAINED:
        raise InputError(f"found the network {short_repr(name)}, allowed: {', '.join(PRETRAINED)}.")
    return weights.shipped(name, _skeleton)


def _skeleton(offsets: list[int], widths: list[int], standardized: bool) -> UNet:
    """The shapes of a network, checked: what a file says decides how much memory is asked for."""
    whole = lambda values, most: all(type(n) is int and abs(n) <= most for n in values)
    if not (whole(offsets, _MOST_OFFSET) and whole(widths, _MOST_WIDTH) and type(standardized) is bool):
        raise ValueError("its offsets, widths or kind are out of range")
    if not (1 <= len(widths) <= _MOST_LEVELS and len(offsets) <= 2 * _MOST_OFFSET + 1 and min(widths) > 0):
        raise ValueError("its number of levels or slices is out of range")
    make = lambda key: UNet(tuple(offsets), tuple(widths), standardized=standardized, key=key)
    return eqx.filter_eval_shape(make, jax.random.key(0))


def _convolution(channels: int, width: int, size: int, key: PRNGKeyArray) -> eqx.nn.Conv2d:
    layer = eqx.nn.Conv2d(channels, width, size, padding="SAME", key=key)
    # Equinox starts smaller, and without normalisation layers the signal would fade on the way down.
    start = jax.nn.initializers.he_normal(in_axis=1, out_axis=0)(key, layer.weight.shape, jnp.float32)
    return eqx.tree_at(lambda l: (l.weight, l.bias), layer, (start, jnp.zeros((width, 1, 1), jnp.float32)))


def _halved(x: Float[Array, "channel y x"]) -> Float[Array, "channel y_half x_half"]:
    """The largest of each 2 x 2 voxels."""
    channels, rows, columns = x.shape
    return x.reshape(channels, rows // 2, 2, columns // 2, 2).max((2, 4))


def _doubled(x: Float[Array, "channel y x"]) -> Float[Array, "channel y_double x_double"]:
    return jnp.repeat(jnp.repeat(x, 2, 1), 2, 2)


def _cut(x: Float[Array, "*channel y x"], edge: int) -> Float[Array, "*channel y_inner x_inner"]:
    """Without so many voxels at each edge."""
    return x[..., edge : x.shape[-2] - edge, edge : x.shape[-1] - edge]
