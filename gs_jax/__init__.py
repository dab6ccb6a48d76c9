"""Design, simulate and reconstruct with lensless 3-D microscopes of random microlenses.

Lengths are in millimetres, lateral points `(x, y)`, volumes `[depth, row, column]`. Each name says what it is in one
word: *differentiable*, for all that JAX transforms; *compiled*, for `jit` and `vmap`, without gradients; *host*, for
numbers and not for what JAX traces; *file*, which it reads or writes.

The microscope:

    Imager               A microlens array in front of a sensor, and the light: the one geometry of the package
    MicrolensArray       Plano-convex microlenses on one plate, their vertices in one plane
    Sensor               A camera sensor of square pixels, in the plane `z = -v` behind the lenses
    Layers               Plane-parallel layers on top of each other
    Sample               The medium that holds the object, such as water or a gel
    refractive_index     The refractive index of a material, relative to air
    EmissionBand         Wavelengths that stand for an emission band, by their shares of the light that is detected
    Grid                 Voxels of the object space; centred on the axis, unless it has another origin
    Design               A microscope, with the tables and keys of its file
    read_design          The design in a TOML file. A `centers_file`, relative to it, is read in place of `centers_mm`
    write_design         Writes a design as TOML, its centres inside, whole or not at all; what is read back is equal
    geomscope            The paper's microscope (Table 1), with a random layout of our own of the same statistics
    random_layout        A random layout with a given pitch, without gaps between the lenses
    calibrate            Estimate a microscope's geometry from captures of point sources, starting from its design

From a capture to a volume:

    read_capture         A capture `(row, column)` in the file's own type: uint8, uint16 or float32
    reconstruct          Reconstruct the volume that an image shows
    Reconstructor        What all images of a microscope share for `reconstruct`: the optics and the method
    BackProjection       Back-projection, the paper's reconstruction: one pass, no PSF
    PinholeRichardsonLucy  Richardson-Lucy with the pinhole back-projection in place of the adjoint
    RichardsonLucy       Richardson-Lucy: `x <- x A'(image / (A x + background)) / A'1`, from a uniform start
    FISTA                FISTA: non-negative least squares with an L1 penalty, for any operator
    Unrolled             Unrolled inversion by trained networks; `Unrolled.pretrained()` loads those of the package
    Surface              Sheets through the volume: a brightness and a depth for each column, fitted to the image
    fit_surface          Fit sheets to an image: a brightness and a depth for each column of the grid
    ADMM                 ADMM: non-negative least squares with total variation and an L1 penalty, for any operator
    ConvolutionADMM      ADMM for a `ConvolutionOperator`, with 3-D total variation and an L1 penalty
    deconvolve           Reconstruct a plane, or a volume, from its image through measured PSFs
    show                 Maximum projections of a volume along z, y and x, to scale in mm, with points as circles
    write_volume         Writes a volume as float32, never rescaled or clipped, whole or not at all
    read_volume          A volume and its grid, from an OME-TIFF or an OME-Zarr (0.4 or 0.5) that has depths

Without the background:

    suppress             Suppress what is out of focus in a back-projected volume, slice by slice, by a network
    find_points          Find the points that a capture shows: those that nearly all of their lenses see
    write_points         Writes points `(x, y, z, intensity)`, mm, as CSV; what is read back is equal
    read_points          Points `(x, y, z, intensity)` from a CSV file with the header `x_mm,y_mm,z_mm,intensity`

From a scene to a capture:

    simulate             The noiseless image of points or of a volume on the sensor; `expose` adds a camera's noise
    Camera               A camera, which converts electrons to counts
    expose               The counts of one exposure: uint8 for a camera of up to 8 bits, else uint16
    rasterize            The volume that a scene makes on a grid: linear weights along x, y and z
    write_capture        Writes a capture as it is, by its suffix a TIFF, a PNG or an .npy; whole or not at all

The operators themselves, differentiable:

    backproject          Sum, for each voxel, the pixel under each lens that sees it (paper, "Object reconstruction")
    backproject_adjoint  The exact adjoint of `backproject`: each voxel adds to the pixels that it is read from
    forward              The image of a volume, summed lens by lens: Eq. (2), or with all of the light
    ImagingOperator      The forward model as a `lineax` operator; its transpose `.T` is the exact adjoint
    BackprojectionOperator  The paper's back-projection as a `lineax` operator, image to volume
    ConvolutionOperator  Imaging through measured PSFs, one for each plane; its transpose `.T` is the exact adjoint
    psf_model            The PSF model of a microscope for a grid, for `forward` and the solvers
    solve                Run a solver on an image, for all its steps or until its tolerance is met

Better designs, and their molds:

    optimize             Search for the imager of the least loss
    free                 Which numbers of an imager a search may change
    objectives           Derived quantities of an imager at depths (Eqs. 4-11), for datasheets and searches
    run_study            Search for a design that does what a study wants
    read_study           The study in a TOML file
    make_mold            Writes the mold of a design, or the array, for printing, with a picture and a report

How good it is:

    cross_validated      Score a method on a capture: reconstruct without some lenses, predict their light, and compare
    forward_residual     Image a volume again, and compare the image with the capture
    quality              PSNR, SSIM and MSE of a volume, after the scalar gain that fits it best
    localization         Match found points with true ones, each at most once, and score them

Around all:

    Progress             Progress on standard error: bars on a terminal, otherwise a line every ten seconds
    InputError           Wrong input from a user, explained in one line

Examples start from three lenses in front of 200 x 200 pixels, and the image of a point:

>>> import gs_jax as gs, numpy as np
>>> array = gs.MicrolensArray([[-1.2, 0.3], [0.1, -0.9], [1.1, 0.6]])
>>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
>>> grid = gs.Grid.over(scope.sensor, depths=[18.0, 20.0, 22.0], pitch=0.1)
>>> point = np.array([[0.2, -0.1, 20.0, 1.0]])  # x, y, z in mm, and its light
>>> image = gs.simulate(point, scope, optics="near", psf="geometric")
"""

import lazy_loader

# What each name is, `__init__.pyi` says, to type checkers too. A name is imported when it is asked for.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
