"""Every way from an image to a volume, as an object that holds its options, and by name."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..base.errors import InputError
from ..solvers.admm import ADMM
from ..solvers.base import Solver
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import TENTS, RichardsonLucy
from ..solvers.unrolled import Unrolled


class BackProjection(eqx.Module):
    """`backproject`, the paper's reconstruction: one step, no PSF.

    *Host.*

    Parameters
    ----------
    interpolation
        Between pixels, `"linear"` or `"nearest"` (the paper's).
    normalize
        Divide by the summed weights, so that a uniform image gives a uniform volume.

    Raises
    ------
    InputError
        If there is no such interpolation.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> volume = gs.reconstruct(np.ones((200, 200)), scope, grid, gs.BackProjection(normalize=True))
    >>> print(round(float(volume[1, 20, 20]), 3))
    1.0
    """

    interpolation: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.interpolation not in ("linear", "nearest"):
            raise InputError(f"interpolation: found {self.interpolation!r}, allowed: linear, nearest.")


class ListRichardsonLucy(eqx.Module):
    """Richardson-Lucy on the pixel-voxel lists of back-projection.

    *Host.*

    Each voxel is multiplied by the mean ratio of what was seen to what is expected, weighted by the envelope, over the
    pixels that back-projection would read: `backproject(ratio, ..., normalize=True)`. What is expected is the
    forward model's image. Without a PSF this is `RichardsonLucy` with the ray operator; with one, what goes back is
    sharper than the adjoint, and takes fewer steps. Parameters and errors as there.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> import numpy as np
    >>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
    >>> image = gs.simulate(point, scope, optics="near", psf="geometric")
    >>> volume = gs.reconstruct(image, scope, grid, gs.ListRichardsonLucy(steps=3), optics="near")
    >>> print(volume.argmax() == np.ravel_multi_index((1, 19, 22), volume.shape))
    True
    """

    steps: int = eqx.field(static=True, default=20)
    tolerance: float = eqx.field(static=True, default=0.0)
    accelerate: bool = eqx.field(static=True, default=False)
    tents: int = eqx.field(static=True, default=0)
    least_seen: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        self.solver()

    def solver(self, background: Float[np.ndarray, "row column"] | float = 0.0) -> RichardsonLucy:
        """The solver that does it, with a known background."""
        options = {"accelerate": self.accelerate, "tents": self.tents, "least_seen": self.least_seen}
        return RichardsonLucy(self.steps, self.tolerance, background, **options)


# What both kinds of Richardson-Lucy have. Near the field's edge one lens sees a voxel, in its middle a dozen.
_LUCY = {"accelerate": True, "tents": TENTS, "least_seen": 0.3}

Method = BackProjection | ListRichardsonLucy | Solver

# By the name that the command line and the benchmark know it by: from the number of steps to the method. Unrolled
# steps are as many as were trained.
METHODS: dict[str, Callable[[int], Method]] = {
    "backproject": lambda steps: BackProjection(),
    "list-rl": lambda steps: ListRichardsonLucy(steps, **_LUCY),
    "richardson-lucy": lambda steps: RichardsonLucy(steps, **_LUCY),
    "fista": FISTA,
    "admm": ADMM,
    "unrolled": lambda steps: Unrolled.pretrained(),
}
