"""The imaging system, and back-projection, as `lineax` operators."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Num

from ..linear.matrix_free import MatrixFree
from ..microscope.geometry import Imager
from ..microscope.grid import Grid
from .backprojection import backproject
from .forward_model import Optics, check_optics, forward, psf_model


class ImagingOperator(MatrixFree):
    """The forward model as a `lineax` operator; its transpose `.T` is the exact adjoint.

    *Differentiable.*

    It is a pytree whose leaves are the numbers of the imager, the grid and the optics: a compiled
    function that takes it as an argument is not compiled again when they change. Matrix-free; `lx.linear_solve`,
    `gs_jax.solve`, `jax.vmap` and `jax.grad` take it.

    Parameters
    ----------
    imager, grid
        The microscope and the voxels.
    optics
        As for `forward`, or the `fidelity` of `psf_model`, by which it is made. With None each lens is a pinhole, and
        the transpose is `backproject`. Other models are tables,
        which do not follow changes of the imager and pass no derivative to the shape of the lenses. Chief rays, and
        with a `FieldVaryingPsf` the clear areas, are computed from the imager at each use and differentiated.

    Examples
    --------
    >>> A = gs.ImagingOperator(scope, grid)
    >>> A.in_structure().shape, A.out_structure().shape
    ((3, 41, 41), (200, 200))
    """

    imager: Imager
    grid: Grid
    optics: Optics | str = None

    def __post_init__(self):
        if isinstance(self.optics, str):
            self.optics = psf_model(self.imager, self.grid, self.optics)

    def __check_init__(self):
        check_optics(self.optics, self.imager, self.grid)

    def mv(self, vector: Num[Array | np.ndarray, "depth y x"]) -> Float[Array, "row column"]:
        """The image of a volume."""
        assert not isinstance(self.optics, str)
        return forward(vector, self.imager, self.grid, self.optics)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return _volume_structure(self.imager, self.grid)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return _image_structure(self.imager)


class BackprojectionOperator(MatrixFree):
    """The paper's back-projection as a `lineax` operator, image to volume.

    *Differentiable.*

    A pytree like `ImagingOperator`, whose transpose it is for pinholes.

    Parameters
    ----------
    imager, grid, method, normalize, distortion
        As for `backproject`.

    Examples
    --------
    >>> B = gs.BackprojectionOperator(scope, gs.Grid.over(scope.sensor, depths=[20.0], pitch=0.1), normalize=True)
    >>> B.in_structure().shape, B.out_structure().shape
    ((200, 200), (1, 41, 41))
    """

    imager: Imager
    grid: Grid
    method: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)
    distortion: Float[Array | np.ndarray, " depth"] | None = None

    def mv(self, vector: Num[Array | np.ndarray, "row column"]) -> Float[Array, "depth y x"]:
        """The volume of an image."""
        options = {"method": self.method, "normalize": self.normalize, "distortion": self.distortion}
        return backproject(vector, self.imager, self.grid, **options)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return _image_structure(self.imager)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return _volume_structure(self.imager, self.grid)


def _volume_structure(imager: Imager, grid: Grid) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(grid.volume_shape, imager.sensor_distance.dtype)


def _image_structure(imager: Imager) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(imager.sensor.shape, imager.sensor_distance.dtype)
