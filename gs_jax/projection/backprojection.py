"""Pixel back-projection, image to volume, and its exact adjoint; both differentiable."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Num

from ..base.arrays import check_real, jit
from ..base.typing import Image
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from .bilinear import Shapes, image_to_volume, volume_to_image
from .rays import Rays, trace

# Depths computed at once. More are not faster, and patches would grow with the volume.
_DEPTHS = 16


@partial(jit, static_argnames=("method", "normalize"))
def backproject(
    image: Image,
    imager: Imager,
    grid: Grid,
    *,
    method: str = "linear",
    normalize: bool = False,
    distortion: Float[Array | np.ndarray, " depth"] | None = None,
) -> Float[Array, "depth y x"]:
    """Sum, for each voxel, the pixel under each lens that sees it (paper, "Object reconstruction").

    *Differentiable.*

    Differentiable with respect to the image, the grid's depths and origin, and the imager: all that moves chief rays.
    The surface and the aperture of a lens do not, so that their gradients are zero.

    Parameters
    ----------
    image
        `sensor.shape`, of any real type; integers are read without a copy.
    imager, grid
        The microscope that took the image, and the voxels.
    method
        `"linear"` interpolates between the four pixels around the chief ray, so that lens positions have gradients;
        `"nearest"` takes the nearest pixel, as the paper does, without these gradients.
    normalize
        Divide by the sum of the weights, so that a uniform image gives a uniform volume; voxels that no lens sees are
        zero.
    distortion
        Of each depth, as for `Imager.views`: that of the cores of spots, for example. By default the pixels of chief
        rays are read.

    Returns
    -------
    Array
        `grid.volume_shape`, of the image's type if that is float32 or float64, else of the imager's.

    Raises
    ------
    ValueError
        If the image is not `sensor.shape` or complex, `method` is unknown, or there is not one distortion for each
        depth.

    Examples
    --------
    >>> import jax, jax.numpy as jnp
    >>> gs.backproject(image, scope, grid).shape
    (3, 41, 41)
    >>> slope = jax.grad(lambda s: jnp.sum(gs.backproject(image, s, grid) ** 2))(scope)
    >>> slope.array.centers.shape
    (3, 2)
    """
    if image.shape != imager.sensor.shape:
        raise ValueError(f"`image` must be of the sensor's shape {imager.sensor.shape}, got {image.shape}.")
    dtype = _type_of(image, imager)

    def backproject_group(planes):
        depths, distortion = planes
        shapes, rays = _prepare(imager, grid.at(depths), method, dtype, distortion)
        volume = image_to_volume(shapes, rays, image)
        if not normalize:
            return volume
        total = image_to_volume(shapes, rays, None)
        seen = total > 0
        return jnp.where(seen, volume / jnp.where(seen, total, 1), 0)

    distortion = jnp.ones_like(grid.depths) if distortion is None else jnp.asarray(distortion, grid.depths.dtype)
    if distortion.shape != grid.depths.shape:
        raise ValueError(f"`distortion` must be of the depths' shape {grid.depths.shape}, got {distortion.shape}.")
    volume = lax.map(backproject_group, (_in_groups(grid.depths), _in_groups(distortion)))
    return volume.reshape(-1, *grid.shape)[: grid.depths.size]


def backproject_on_all_devices(
    image: Image, imager: Imager, grid: Grid, *, distortion: Float[np.ndarray, " depth"] | None = None, **options
) -> Float[Array, "depth y x"]:
    """`backproject` with the depths divided evenly among the devices of this process."""
    distortion = np.ones(grid.depths.size) if distortion is None else distortion
    missing = -grid.depths.size % jax.local_device_count()
    planes = (np.pad(part, (0, missing), mode="edge") for part in (grid.depths, distortion))
    return _backproject_sharded(image, imager, grid, *planes, **options)[: grid.depths.size]


@partial(jit, static_argnames=("method", "normalize"))
def _backproject_sharded(image, imager, grid, depths, distortion, **options):
    mesh, replicated, sharded = Mesh(np.array(jax.local_devices()), ("depth",)), PartitionSpec(), PartitionSpec("depth")

    def project(image, imager, grid, depths, distortion):
        return backproject(image, imager, grid.at(depths), distortion=distortion, **options)

    # The kernels do not declare which results vary between devices.
    specs = {"in_specs": (replicated, replicated, replicated, sharded, sharded), "out_specs": sharded}
    return jax.shard_map(project, mesh=mesh, **specs, check_vma=False)(image, imager, grid, depths, distortion)


@partial(jit, static_argnames=("method",))
def backproject_adjoint(
    volume: Num[Array | np.ndarray, "depth y x"], imager: Imager, grid: Grid, *, method: str = "linear"
) -> Float[Array, "row column"]:
    """The exact adjoint of `backproject`: each voxel adds to the pixels that it is read from.

    *Differentiable.*

    With `method="linear"` it is the image of a volume by pinholes: Eq. (2) with a point for PSF_o. Differentiable with
    respect to the volume, the imager and the grid's depths and origin.

    Parameters
    ----------
    volume
        `grid.volume_shape`; integers are converted to the imager's type.
    imager, grid, method
        As for `backproject`.

    Returns
    -------
    Array
        `sensor.shape`, of the volume's type.

    Raises
    ------
    ValueError
        If the volume is not of the grid's shape, or `method` is unknown.

    Examples
    --------
    >>> volume = np.random.default_rng(0).random(grid.volume_shape)
    >>> there = np.vdot(gs.backproject(image, scope, grid), volume)
    >>> back = np.vdot(image, gs.backproject_adjoint(volume, scope, grid))
    >>> print(round(float(there / back), 4))
    1.0
    """
    if volume.shape != grid.volume_shape:
        raise ValueError(f"`volume` must be of the grid's shape {grid.volume_shape}, got {volume.shape}.")
    volume = as_volume(volume, imager)

    def add_depths(image, group):
        depths, volume = group
        shapes, rays = _prepare(imager, grid.at(depths), method, volume.dtype)
        return image + volume_to_image(shapes, rays, volume), None

    depths = _in_groups(grid.depths)
    padding = [(0, depths.size - grid.depths.size), (0, 0), (0, 0)]
    volume = jnp.pad(volume, padding).reshape(*depths.shape, *grid.shape)
    return lax.scan(add_depths, jnp.zeros(imager.sensor.shape, volume.dtype), (depths, volume))[0]


def as_volume(volume: Num[Array | np.ndarray, "*shape"], imager: Imager) -> Float[Array, "*shape"]:
    """The volume in its own floating type, or as the imager's if it has integers."""
    return jnp.asarray(volume, _type_of(volume, imager))


def _type_of(array, imager):
    """The array's own type, if it is precise enough for the places of pixels; otherwise the imager's."""
    check_real("image or volume", array)
    precise = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize >= 4
    return array.dtype if precise else imager.sensor_distance.dtype


def _in_groups(depths: Float[Array, " depth"]) -> Float[Array, "group size"]:
    """Numbers of depths in groups of one size, at most `_DEPTHS`; the last is filled up with that of the last depth."""
    groups = -(-depths.size // _DEPTHS)
    size = -(-depths.size // groups)
    return jnp.pad(depths, (0, groups * size - depths.size), mode="edge").reshape(groups, size)


def _prepare(imager: Imager, grid: Grid, method: str, dtype, distortion=None) -> tuple[Shapes, Rays]:
    if method not in ("linear", "nearest"):
        raise ValueError(f'`method` must be "linear" or "nearest", got {method!r}.')
    rays = trace(imager, grid, nearest=method == "nearest", dtype=dtype, distortion=distortion)
    return Shapes(imager.sensor.shape, grid.volume_shape), rays
