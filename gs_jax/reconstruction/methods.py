"""Reconstruction methods that are no solvers of `gs_jax.solvers`, and the table of all methods by name."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Num

from ..base.errors import InputError
from ..solvers.admm import ADMM
from ..solvers.base import Operator, Solver, UnmatchedAdjointOperator
from ..solvers.fista import FISTA
from ..solvers.richardson_lucy import BACKGROUND_KNOTS, RichardsonLucy, State
from ..solvers.surface import Surface
from ..solvers.unrolled import Unrolled


class BackProjection(eqx.Module):
    """Back-projection, the paper's reconstruction: one pass, no PSF.

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
        If `interpolation` is neither.

    Examples
    --------
    >>> volume = gs.reconstruct(np.ones((200, 200)), scope, grid, gs.BackProjection(normalize=True))
    >>> print(round(float(volume[1, 20, 20]), 3))
    1.0
    """

    interpolation: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.interpolation not in ("linear", "nearest"):
            raise InputError(f"interpolation must be 'linear' or 'nearest', got {self.interpolation!r}.")


class PinholeRichardsonLucy(RichardsonLucy):
    """Richardson-Lucy with the pinhole back-projection in place of the adjoint.

    *Host.*

    Each voxel is multiplied by the mean ratio of the measured to the expected image over the pixels that
    back-projection reads: `backproject(ratio, ..., normalize=True)`. The expected image is the forward model's. Without
    a PSF this is `RichardsonLucy` with the ray operator; with one, the back-projection is sharper than the adjoint, and
    fewer steps suffice. Parameters and errors are those of `RichardsonLucy`.

    Examples
    --------
    >>> volume = gs.reconstruct(image, scope, grid, gs.PinholeRichardsonLucy(steps=3), optics="near")
    >>> print(volume.argmax() == np.ravel_multi_index((1, 19, 22), volume.shape))
    True
    """

    def init(self, A: Operator, image: Num[Array | np.ndarray, "..."]) -> State:
        if not isinstance(A, UnmatchedAdjointOperator):
            raise InputError(f"PinholeRichardsonLucy() must be used with reconstruct, got a {type(A).__name__}.")
        return super().init(A, image)


# Near the edge of the field one lens sees a voxel, in its middle a dozen.
_LUCY = {"accelerate": True, "background_knots": BACKGROUND_KNOTS, "min_sensitivity": 0.3}

Method = BackProjection | Solver

# Methods by the names of the command line and the benchmark, as functions of the number of steps. Those that are not in
# `STEPPED` take none: the unrolled solver has as many as were trained, and sheets as many as they need.
STEPPED = ("list-rl", "richardson-lucy", "fista", "admm")
METHODS: dict[str, Callable[[int], Method]] = {
    "backproject": lambda steps: BackProjection(),
    "list-rl": lambda steps: PinholeRichardsonLucy(steps, **_LUCY),
    "richardson-lucy": lambda steps: RichardsonLucy(steps, **_LUCY),
    "fista": FISTA,
    "admm": ADMM,
    "unrolled": lambda steps: Unrolled.pretrained(),
    "surface": lambda steps: Surface(),
}


def check_stop(method: Method, stop_at_discrepancy: bool) -> None:
    """Raise `InputError` if a method cannot stop at the noise: it has no steps, or steps that belong together."""
    if stop_at_discrepancy and isinstance(method, BackProjection | Unrolled | Surface):
        allowed = "RichardsonLucy(), PinholeRichardsonLucy(), FISTA() or ADMM()"
        raise InputError(f"stop_at_discrepancy must be used with {allowed}, got {type(method).__name__}().")
