"""Type aliases that several modules use in their annotations."""

import os
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float, Float32, Num

PathLike = str | os.PathLike[str]

# Numbers of the host, which JAX does not trace.
Number = float | int
# One number, traced or not.
ScalarLike = Float[ArrayLike, ""]
# Numbers or arrays whose shapes broadcast with each other, and the result of such a call.
Real = Float[Array | np.ndarray, "*#shape"] | float | int
Result = Float[Array, "..."]
# Values of JAX or NumPy, whichever the arguments are: one number, several, or coordinates `(2, ...)`.
Scalar = Any
Scalars = Any
Coordinates = Any

Image = Num[Array | np.ndarray, "row column"]
Volume = Float32[np.ndarray, "depth y x"]
Points = Float[Array | np.ndarray, "point 4"]
