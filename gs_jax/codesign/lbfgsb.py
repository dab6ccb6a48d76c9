"""L-BFGS-B by `jaxopt`, which is no longer maintained: the only module that imports it."""

import warnings
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float


class LBFGSB:
    """L-BFGS-B (Byrd, Lu, Nocedal and Zhu, SIAM J. Sci. Comput. 16, 1190, 1995), which keeps bounds by itself."""

    def of(self, objective: Callable[..., Float[Array, ""]]) -> Any:
        """A smooth objective step by step: `init_state(x, bounds)`, `update(x, state, bounds)`.

        Scale the variables to about one before: the first step is as long as the gradient.
        """
        # Here, so that the other solvers do without a package that is no longer maintained.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
            import jaxopt
        return jaxopt.LBFGSB(objective, maxiter=1, tol=0.0, implicit_diff=False)
