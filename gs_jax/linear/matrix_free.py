"""The contract of this package's operators for `lineax`: real functions of arrays, without a matrix."""

from abc import abstractmethod

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float, Num

from ..base.arrays import check_real, native


class MatrixFree(lx.AbstractLinearOperator):
    """A real linear operator from one array to one array, which its subclasses give as a function."""

    @abstractmethod
    def mv(self, vector: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
        """Apply the operator to an array."""

    @abstractmethod
    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and type of the arrays that the operator applies to."""

    @abstractmethod
    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and type of the results."""

    def transpose(self) -> lx.AbstractLinearOperator:
        """The exact adjoint, as `.T`."""
        return Transposed(self)

    def as_matrix(self) -> Float[Array, "out in"]:
        """The dense matrix, for small systems."""
        return lx.FunctionLinearOperator(self.mv, self.in_structure()).as_matrix()


class Transposed(MatrixFree):
    """The transpose of an operator."""

    operator: MatrixFree

    def mv(self, vector: Num[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
        check_real("vector", vector)
        vector = jnp.asarray(native(vector), self.operator.out_structure().dtype)
        return jax.linear_transpose(self.operator.mv, self.operator.in_structure())(vector)[0]

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self.operator.out_structure()

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self.operator.in_structure()

    def transpose(self) -> MatrixFree:
        return self.operator

    def as_matrix(self) -> Float[Array, "out in"]:
        return self.operator.as_matrix().T


# lineax dispatches these functions on the class, and on its base classes.
def _has_no_structure(operator: MatrixFree) -> bool:
    return False


def _itself(operator: MatrixFree) -> MatrixFree:
    return operator


def _materialise(operator: MatrixFree) -> lx.AbstractLinearOperator:
    return lx.materialise(lx.FunctionLinearOperator(operator.mv, operator.in_structure()))


lx.is_symmetric.register(MatrixFree, _has_no_structure)
lx.is_diagonal.register(MatrixFree, _has_no_structure)
lx.is_tridiagonal.register(MatrixFree, _has_no_structure)
lx.is_lower_triangular.register(MatrixFree, _has_no_structure)
lx.is_upper_triangular.register(MatrixFree, _has_no_structure)
lx.is_positive_semidefinite.register(MatrixFree, _has_no_structure)
lx.is_negative_semidefinite.register(MatrixFree, _has_no_structure)
lx.has_unit_diagonal.register(MatrixFree, _has_no_structure)
lx.linearise.register(MatrixFree, _itself)
lx.conj.register(MatrixFree, _itself)
lx.materialise.register(MatrixFree, _materialise)
