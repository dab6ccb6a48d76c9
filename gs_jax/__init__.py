"""Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses."""

from ._version import __version__ as __version__
from .backprojection import backproject as backproject, backproject_adjoint as backproject_adjoint
from .forward import forward as forward
from .geometry import (
    Grid as Grid,
    Imager as Imager,
    MicrolensArray as MicrolensArray,
    Sensor as Sensor,
    chief_ray as chief_ray,
    envelope as envelope,
)
from .operators import ray_operator as ray_operator
