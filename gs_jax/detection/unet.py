"""Background suppression by a U-Net (paper, "Background suppression through a convolutional neural network").

A back-projected volume shows every object also in the slices where it is not, blurred or as ghosts. The network
predicts what is in focus in a slice, from that slice alone (the paper's) or from several around it (ours).
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..base.arrays import check_finite, host_code
from ..base.errors import InputError, short_repr
from ..base.typing import PathLike, Volume
from ..base.weights import load_weights, save_weights, shipped_weights
from ..io.files import atomic_write, check_input, check_output, decoding
from ..io.provenance import Provenance
from .background import mirror_indices

# Networks that ship with the package, and limits of what a file of weights may hold.
PRETRAINED = ("paper", "multislice")
_MOST_LEVELS, _MOST_WIDTH, _MOST_OFFSET = 8, 4096, 64
# Largest side of a tile's core, in voxels: about half a GiB of memory.
_CORE = 1024
# Voxels at each edge that depend on the zero padding of a block's two convolutions.
_PADDED = 2


class Block(eqx.Module):
    """Two 3 x 3 convolutions, each followed by ReLU."""

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d

    def __init__(self, channels: int, width: int, *, key: PRNGKeyArray):
        one, two = jax.random.split(key)
        self.first = _convolution(channels, width, 3, one)
        self.second = _convolution(width, width, 3, two)

    def __call__(self, x: Float[Array, "channel y x"]) -> Float[Array, "width y x"]:
        return jax.nn.relu(self.second(jax.nn.relu(self.first(x))))


class UNet(eqx.Module):
    """U-Net (Ronneberger, Fischer, Brox, MICCAI 2015) from several slices of a volume to one.

    Each level has two convolutions and half as many rows and columns as the one above. On the way up, a level is
    narrowed by a 1 x 1 convolution, upsampled and concatenated with the same level of the way down.

    Parameters
    ----------
    offsets
        Input slices relative to the output slice: `(0,)` is that slice alone.
    widths
        Channels of each level, finest first.
    standardized
        Whether inputs are volumes less each plane's median, in standard deviations; otherwise they are volumes over
        their maximum. `suppress` scales them.
    key
        For the initial weights (He's normal distribution).

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
            raise ValueError(f"`offsets` must have 0, the output slice, got {offsets}.")
        if not widths:
            raise ValueError("`widths` must have one level or more, got none.")
        self.offsets, self.widths, self.standardized = offsets, widths, standardized
        pairs = list(zip(widths, widths[1:], strict=False))
        keys = iter(jax.random.split(key, 3 * len(widths)))
        self.down = tuple(Block(a, b, key=next(keys)) for a, b in zip((len(offsets), *widths), widths, strict=False))
        self.narrow = tuple(_convolution(b, a, 1, next(keys)) for a, b in reversed(pairs))
        self.up = tuple(Block(2 * a, a, key=next(keys)) for a, _ in reversed(pairs))
        self.last = _convolution(widths[0], 1, 1, next(keys))

    @property
    def multiple(self) -> int:
        """Rows and columns must be a multiple of this number."""
        return 2 ** (len(self.widths) - 1)

    @property
    def margin(self) -> int:
        """Voxels around a tile's core that its output depends on: `6 * 2^L - 2` for L levels below the finest.

        On the way down each level needs 2 voxels for its convolutions and twice the margin of the level below; the
        lowest needs 4, 2 of them for the way up.
        """
        return 6 * self.multiple - _PADDED

    def __call__(self, slices: Float[Array, "channel y x"]) -> Float[Array, "y x"]:
        """Predict what is in focus; slightly negative values are possible, which `suppress` clips."""
        return self._apply(slices, 0)

    def core(self, slices: Float[Array, "channel y x"]) -> Float[Array, "y_core x_core"]:
        """The same without `margin` at each edge, where the output depends on zero padding; faster than cropping."""
        return _crop(self._apply(slices, _PADDED), _PADDED)

    def _apply(self, slices, padded: int):
        """Crop so many voxels from the edges of each block's output."""
        x, skipped = slices, []
        for level, block in enumerate(self.down):
            x = _crop(block(x if level == 0 else _max_pool(x)), padded)
            skipped.append(x)
        for narrow, block, same in zip(self.narrow, self.up, reversed(skipped[:-1]), strict=True):
            low = _upsample(narrow(x))
            beside = _crop(same, (same.shape[1] - low.shape[1]) // 2)
            x = _crop(block(jnp.concatenate([beside, low])), padded)
        return self.last(x)[0]


def paper_network(key: PRNGKeyArray) -> UNet:
    """The paper's network: single slices, five levels of 16 to 256 channels, the widths of the authors' code."""
    return UNet((0,), (16, 32, 64, 128, 256), standardized=False, key=key)


def multislice_network(key: PRNGKeyArray) -> UNet:
    """Our network: a slice and three on each side, which show where light is in focus."""
    return UNet((-3, -2, -1, 0, 1, 2, 3), (16, 32, 64, 128), standardized=True, key=key)


@host_code()
def suppress(volume: Float[Array | np.ndarray, "depth y x"], network: UNet | None = None) -> Volume:
    """Suppress what is out of focus in a back-projected volume, slice by slice, by a network.

    *Host.*

    The result is in the volume's unit, above each plane's background. The first and last slices are repeated beyond the
    ends, and planes are mirrored at their edges. Planes are processed in tiles that overlap by the network's receptive
    field, so that the result does not depend on the tiles and memory does not grow with the planes.

    Parameters
    ----------
    volume
        Finite, of any size, as `reconstruct` makes it by back-projection.
    network
        From `pretrained`, `read_weights` or training; by default ours, which ships with the package.

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
        volume, unit = standardize(volume)
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
            core = np.asarray(_core(network, tile))
            target = result[depth, row : row + core.shape[0], column : column + core.shape[1]]
            target[...] = core[: target.shape[0], : target.shape[1]]
    return unit * result


def standardize(volume: Float[np.ndarray, "depth y x"]) -> tuple[Float[np.ndarray, "depth y x"], float]:
    """Subtract the median of each plane; return the rest and its standard deviation."""
    above = volume - np.median(volume, axis=(1, 2), keepdims=True)
    return above, float(np.sqrt(np.mean(np.square(above, dtype=np.float64))))


@eqx.filter_jit
def _core(network: UNet, tile):
    return jnp.maximum(network.core(jnp.asarray(tile, network.last.weight.dtype)), 0)


def _tiles(size: int, network: UNet) -> list[tuple[int, np.ndarray]]:
    """Start of each tile's core along an axis, and the voxels of core and margins, mirrored at the ends."""
    count = -(-size // _CORE)
    core = -(-size // (count * network.multiple)) * network.multiple
    offsets = np.arange(-network.margin, core + network.margin)
    return [(start, mirror_indices(start + offsets, size)) for start in range(0, size, core)]


def write_weights(path: PathLike, network: UNet, provenance: Provenance | None = None) -> None:
    """Write a network as `.npz`; `InputError` as `check_output`."""
    about = {"offsets": network.offsets, "widths": network.widths, "standardized": network.standardized}
    with atomic_write(check_output(path, [".npz"])) as temporary:
        save_weights(temporary, network, about, provenance)


def read_weights(path: PathLike) -> UNet:
    """Read a network that `write_weights` wrote, in float32. Nothing in the file is executed.

    Raises `InputError` if the file cannot be read, or does not hold the finite arrays of a network.
    """
    with decoding(path := check_input(path), "file of weights (.npz)"):
        return load_weights(path, _skeleton)


def pretrained(name: str = "multislice") -> UNet:
    """A network that ships with the package, `"paper"` or `"multislice"` (ours); `InputError` for other names."""
    if name not in PRETRAINED:
        raise InputError(f"network must be one of {', '.join(PRETRAINED)}, got {short_repr(name)}.")
    return shipped_weights(name, _skeleton)


def _skeleton(offsets: list[int], widths: list[int], standardized: bool) -> UNet:
    """The shapes of a network. Checked, as numbers in a file decide how much memory is allocated."""
    whole = lambda values, most: all(type(n) is int and abs(n) <= most for n in values)
    if not (whole(offsets, _MOST_OFFSET) and whole(widths, _MOST_WIDTH) and type(standardized) is bool):
        raise ValueError("its offsets, widths or `standardized` are out of range")
    if not (1 <= len(widths) <= _MOST_LEVELS and len(offsets) <= 2 * _MOST_OFFSET + 1 and min(widths) > 0):
        raise ValueError("its number of levels or slices is out of range")
    make = lambda key: UNet(tuple(offsets), tuple(widths), standardized=standardized, key=key)
    return eqx.filter_eval_shape(make, jax.random.key(0))


def _convolution(channels: int, width: int, size: int, key: PRNGKeyArray) -> eqx.nn.Conv2d:
    layer = eqx.nn.Conv2d(channels, width, size, padding="SAME", key=key)
    # Equinox's smaller initial weights would make the signal fade without normalisation layers.
    start = jax.nn.initializers.he_normal(in_axis=1, out_axis=0)(key, layer.weight.shape, jnp.float32)
    return eqx.tree_at(lambda l: (l.weight, l.bias), layer, (start, jnp.zeros((width, 1, 1), jnp.float32)))


def _max_pool(x: Float[Array, "channel y x"]) -> Float[Array, "channel y_half x_half"]:
    channels, rows, columns = x.shape
    return x.reshape(channels, rows // 2, 2, columns // 2, 2).max((2, 4))


def _upsample(x: Float[Array, "channel y x"]) -> Float[Array, "channel y_double x_double"]:
    return jnp.repeat(jnp.repeat(x, 2, 1), 2, 2)


def _crop(x: Float[Array, "*channel y x"], edge: int) -> Float[Array, "*channel y_inner x_inner"]:
    return x[..., edge : x.shape[-2] - edge, edge : x.shape[-1] - edge]
