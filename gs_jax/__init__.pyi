from . import objectives as objectives
from ._version import __version__ as __version__
from .apps.pictures import show as show
from .base.errors import InputError as InputError
from .base.progress import Progress as Progress
from .calibration.fit import calibrate as calibrate
from .codesign.parameters import free as free
from .codesign.search import run_study as run_study
from .codesign.solve import optimize as optimize
from .codesign.study import read_study as read_study
from .design.design import Design as Design, read_design as read_design, write_design as write_design
from .design.start import geomscope as geomscope
from .detection.point_finder import find_points as find_points
from .detection.unet import suppress as suppress
from .io.captures import read_capture as read_capture, write_capture as write_capture
from .io.point_tables import read_points as read_points, write_points as write_points
from .io.volumes import read_volume as read_volume, write_volume as write_volume
from .linear.measured_psf import ConvolutionOperator as ConvolutionOperator
from .metrics import localization as localization, quality as quality
from .microscope.geometry import Imager as Imager
from .microscope.grid import Grid as Grid, Sensor as Sensor
from .microscope.layouts import random_layout as random_layout
from .microscope.lenses import MicrolensArray as MicrolensArray
from .microscope.media import (
    EmissionBand as EmissionBand,
    Layers as Layers,
    Sample as Sample,
    refractive_index as refractive_index,
)
from .mold.make import make_mold as make_mold
from .projection.backprojection import backproject as backproject, backproject_adjoint as backproject_adjoint
from .projection.forward_model import forward as forward, psf_model as psf_model
from .projection.operators import (
    BackprojectionOperator as BackprojectionOperator,
    ImagingOperator as ImagingOperator,
)
from .reconstruction.deconvolution import deconvolve as deconvolve
from .reconstruction.pipeline import (
    BackProjection as BackProjection,
    PinholeRichardsonLucy as PinholeRichardsonLucy,
    Reconstructor as Reconstructor,
    reconstruct as reconstruct,
)
from .reconstruction.residual import cross_validated as cross_validated, forward_residual as forward_residual
from .reconstruction.surface_fit import fit_surface as fit_surface
from .simulation import Camera as Camera, expose as expose, rasterize as rasterize, simulate as simulate
from .solvers.admm import ADMM as ADMM, ConvolutionADMM as ConvolutionADMM
from .solvers.base import solve as solve
from .solvers.fista import FISTA as FISTA
from .solvers.richardson_lucy import RichardsonLucy as RichardsonLucy
from .solvers.surface import Surface as Surface
from .solvers.unrolled import Unrolled as Unrolled

__all__: list[str]
