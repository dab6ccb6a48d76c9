"""Imaging through PSFs measured over the field: convolutions with a few kernels, weighted by smooth maps."""

import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import ShapeDtypeStruct
from jaxtyping import Array, Float

from ..base.arrays import as_float
from .measured_psf import ConvolutionOperator
from .operators import as_matrix, no_structure, transpose


class FieldConvolutionOperator(lx.AbstractLinearOperator):
    """Imaging through PSFs that vary over the field: the image is the sum of `kernel * (weight scene)` over components.

    *Differentiable*, a `lineax` operator; its transpose `.T` is the exact adjoint. So few components describe the PSF
    everywhere when it varies smoothly (Flicker and Rigaut, J. Opt. Soc. Am. A 22, 504, 2005; of random multifocal
    masks: Yanny et al., Light Sci. Appl. 9, 171, 2020). `fit_field` of `gs_jax.reconstruction.field_fit` finds them.

    Parameters
    ----------
    kernels
        Of each plane, the component's point being at `(high // 2, wide // 2)`.
    weights
        Of each component over the scene, whose size is that of `scene_size(image_shape, (high, wide))`.
    image_shape
        `(rows, columns)` of the sensor.
    """

    components: ConvolutionOperator
    weights: Float[Array, "depth component down across"]

    def __init__(
        self,
        kernels: Float[Array | np.ndarray, "depth component high wide"],
        weights: Float[Array | np.ndarray, "depth component down across"],
        image_shape: tuple[int, int],
    ):
        self.components = ConvolutionOperator(kernels.reshape(-1, *kernels.shape[2:]), image_shape)
        self.weights = as_float(weights).astype(self.components.spectra.real.dtype)
        expected = (*kernels.shape[:2], *self.components.scene_shape[1:])
        if self.weights.shape != expected:
            raise ValueError(f"`weights` must be {expected}, got {self.weights.shape}.")

    @property
    def image_shape(self) -> tuple[int, int]:
        """`(rows, columns)` of the sensor."""
        return self.components.image_shape

    @property
    def scene_shape(self) -> tuple[int, int, int]:
        """`(depth, tall, wide)` of scenes."""
        depths, _, tall, wide = self.weights.shape
        return depths, tall, wide

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the sensor within a plane of the scene."""
        return self.components.window

    def mv(self, vector: Float[Array | np.ndarray, "depth tall wide"]) -> Float[Array, "row column"]:
        """The image of a scene."""
        light = self.weights * jnp.asarray(vector, self.weights.dtype)[:, None]
        return self.components.mv(light.reshape(self.components.scene_shape))

    def in_structure(self) -> ShapeDtypeStruct:
        return ShapeDtypeStruct(self.scene_shape, self.weights.dtype)

    def out_structure(self) -> ShapeDtypeStruct:
        return self.components.out_structure()

    transpose, as_matrix = transpose, as_matrix


no_structure(FieldConvolutionOperator)
