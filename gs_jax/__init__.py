"""Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""

from ._version import __version__ as __version__
from .geometry import (
    Grid as Grid,
    Imager as Imager,
    MicrolensArray as MicrolensArray,
    Sensor as Sensor,
    chief_ray as chief_ray,
    envelope as envelope,
)
from .projection.backprojection import backproject as backproject, backproject_adjoint as backproject_adjoint
from .projection.forward_model import forward as forward
from .projection.operators import ray_operator as ray_operator
