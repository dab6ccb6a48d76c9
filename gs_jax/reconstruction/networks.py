"""Files of the unrolled inversion's networks, which `gs-jax train` writes."""

from ..base.typing import PathLike
from ..base.weights import load_weights, save_weights
from ..io.files import atomic_write, check_input, check_output, decoding
from ..io.provenance import Provenance
from ..solvers.unrolled import Unrolled, unrolled_skeleton


def write_unrolled(path: PathLike, networks: Unrolled, provenance: Provenance | None = None) -> None:
    """Write the networks as `.npz`; `InputError` as `check_output`."""
    width = networks.layers[0].bias.shape[-1]
    about = {"first": networks.first, "networks": networks.power.size, "squares": networks.last, "width": width}
    with atomic_write(check_output(path, [".npz"])) as temporary:
        save_weights(temporary, networks, about, provenance)


def read_unrolled(path: PathLike) -> Unrolled:
    """Read networks written by `write_unrolled`, in float32, without executing anything from the file.

    Raises `InputError` if the file cannot be read, or does not hold finite arrays of such networks.
    """
    with decoding(path := check_input(path), "file of weights (.npz)"):
        return load_weights(path, unrolled_skeleton)
