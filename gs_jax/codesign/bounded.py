"""L-BFGS-B by `jaxopt`, which is no longer maintained: the only module that imports it."""

import warnings
from collections.abc import Callable

from jaxtyping import Array, Float

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
    import jaxopt


def lbfgsb(objective: Callable[..., Float[Array, ""]]) -> jaxopt.LBFGSB:
    """A smooth objective within bounds (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1190, 1995), step by step:
    `init_state(x, bounds)`, `update(x, state, bounds)`.

    Scale the variables to about one before: the first step is as long as the gradient.
    """
    return jaxopt.LBFGSB(objective, maxiter=1, tol=0.0, implicit_diff=False)
