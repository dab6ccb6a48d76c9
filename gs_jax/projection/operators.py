"""The imaging system, and back-projection, as `lineax` operators."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Num

from ..base.arrays import check_real, native
from ..geometry import Imager
from ..grid import Grid
from .backprojection import backproject
from .forward_model import Optics, check_optics, forward, psf_model


def _volume_structure(self) -> jax.ShapeDtypeStruct:
    """Shape and type of volumes."""
    return jax.ShapeDtypeStruct(self.grid.volume_shape, self.imager.sensor_distance.dtype)


def _image_structure(self) -> jax.ShapeDtypeStruct:
    """Shape and type of images."""
    return jax.ShapeDtypeStruct(self.imager.sensor.shape, self.imager.sensor_distance.dtype)


def transpose(self) -> "Transposed":
    """The exact adjoint, as `.T`."""
    return Transposed(self)


def as_matrix(self) -> Float[Array, "out in"]:
    """The dense matrix, for small systems."""
    return _as_function(self).as_matrix()


def _as_function(operator):
    return lx.FunctionLinearOperator(operator.mv, operator.in_structure())


class ImagingOperator(lx.AbstractLinearOperator):
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
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
    >>> A = gs.ImagingOperator(scope, grid)
    >>> A.in_structure().shape, A.out_structure().shape
    ((3, 41, 41), (200, 200))
    """

    imager: Imager
    grid: Grid
    optics: Optics | str = None
    in_structure, out_structure = _volume_structure, _image_structure
    transpose, as_matrix = transpose, as_matrix

    def __post_init__(self):
        if isinstance(self.optics, str):
            self.optics = psf_model(self.imager, self.grid, self.optics)

    def __check_init__(self):
        check_optics(self.optics, self.imager, self.grid)

    def mv(self, vector: Num[Array | np.ndarray, "depth y x"]) -> Float[Array, "row column"]:
        """The image of a volume."""
        assert not isinstance(self.optics, str)
        return forward(vector, self.imager, self.grid, self.optics)


class BackprojectionOperator(lx.AbstractLinearOperator):
    """The paper's back-projection as a `lineax` operator, image to volume.

    *Differentiable.*

    A pytree like `ImagingOperator`, whose transpose it is for pinholes.

    Parameters
    ----------
    imager, grid, method, normalize, distortion
        As for `backproject`.

    Examples
    --------
    >>> import gs_jax as gs
    >>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> B = gs.BackprojectionOperator(scope, gs.Grid.over(scope.sensor, depths=[20.0], pitch=0.1), normalize=True)
    >>> B.in_structure().shape, B.out_structure().shape
    ((200, 200), (1, 41, 41))
    """

    imager: Imager
    grid: Grid
    method: str = eqx.field(static=True, default="linear")
    normalize: bool = eqx.field(static=True, default=False)
    distortion: Float[Array | np.ndarray, " depth"] | None = None
    in_structure, out_structure = _image_structure, _volume_structure
    transpose, as_matrix = transpose, as_matrix

    def mv(self, vector: Num[Array | np.ndarray, "row column"]) -> Float[Array, "depth y x"]:
        """The volume of an image."""
        options = {"method": self.method, "normalize": self.normalize, "distortion": self.distortion}
        return backproject(vector, self.imager, self.grid, **options)


class Transposed(lx.AbstractLinearOperator):
    """The transpose of one of these operators."""

    operator: lx.AbstractLinearOperator

    def mv(self, vector: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
        check_real("vector", vector)
        vector = jnp.asarray(native(vector), self.operator.out_structure().dtype)
        return jax.linear_transpose(self.operator.mv, self.operator.in_structure())(vector)[0]

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self.operator.out_structure()

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self.operator.in_structure()

    def transpose(self) -> lx.AbstractLinearOperator:
        return self.operator

    def as_matrix(self) -> Float[Array, "out in"]:
        return self.operator.as_matrix().T


def no_structure(operator: type[lx.AbstractLinearOperator]) -> None:
    """Register a class with lineax, which dispatches on it, as real and without special structure."""
    for of in (
        lx.is_symmetric,
        lx.is_diagonal,
        lx.is_tridiagonal,
        lx.is_lower_triangular,
        lx.is_upper_triangular,
        lx.is_positive_semidefinite,
        lx.is_negative_semidefinite,
        lx.has_unit_diagonal,
    ):
        of.register(operator)(lambda _: False)
    for same in (lx.linearise, lx.conj):
        same.register(operator)(lambda operator: operator)
    lx.materialise.register(operator)(lambda operator: lx.materialise(_as_function(operator)))


for _class in (ImagingOperator, BackprojectionOperator, Transposed):
    no_structure(_class)
