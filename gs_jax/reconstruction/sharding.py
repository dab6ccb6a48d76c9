"""Back-projection by all devices of a process: each computes some of the depths, which know nothing of each other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Num

from ..geometry import Imager
from ..grid import Grid
from ..projection.backprojection import backproject


def backproject_by_all(
    image: Num[Array | np.ndarray, "row column"], imager: Imager, grid: Grid, **options
) -> Float[Array, "depth y x"]:
    """As `backproject`, whose arguments it takes; no device does more than one depth more than another."""
    count = grid.depths.size
    last = jnp.full(-count % jax.local_device_count(), grid.depths[-1])
    return _shared(image, imager, grid, jnp.concatenate([grid.depths, last]), **options)[:count]


@partial(jax.jit, static_argnames=("method", "normalize"))
def _shared(image, imager, grid, depths, **options):
    mesh, alike = Mesh(np.array(jax.local_devices()), ("depth",)), PartitionSpec()
    some = PartitionSpec("depth")
    part = lambda image, imager, grid, depths: backproject(image, imager, grid.at(depths), **options)
    # The kernels do not say which of their results differ from device to device.
    shared = jax.shard_map(part, mesh=mesh, in_specs=(alike, alike, alike, some), out_specs=some, check_vma=False)
    return shared(image, imager, grid, depths)
