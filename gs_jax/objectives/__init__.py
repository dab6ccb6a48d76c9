"""Derived quantities of an imager at depths (Eqs. 4-11), for datasheets and searches.

*Differentiable.*

All are functions of an imager and of depths `(depth,)` from the array's front. Lengths are mm. In
place of depths they take `Conditions`, which add constants that do not follow from the imager. `gs_jax.optimize` takes
any function that is made of these; a study names them, with units. Where lenses differ, a function gives what its
docstring says: one value for the whole plate, one row a lens type, or the value of the best type at each depth.
Bare equation numbers mean the GEOMScope paper.

Examples
--------
>>> scope = gs.geomscope().imager()
>>> print(gs.objectives.occupancy(scope, [20.0]).round(2))  # N_e M^2, Eq. 11
[1.11]
"""

from .conditions import Conditions as Conditions, clear_diameter as clear_diameter
from .quantities import (
    aperture_gap as aperture_gap,
    approximate_depth_of_field as approximate_depth_of_field,
    axial_resolution as axial_resolution,
    blur as blur,
    coverage as coverage,
    depth_of_field as depth_of_field,
    edge_slope as edge_slope,
    encircled_radius as encircled_radius,
    f_number as f_number,
    far_limit as far_limit,
    field_of_view as field_of_view,
    focus_distance as focus_distance,
    focus_offset as focus_offset,
    fwhm as fwhm,
    half_light_radius as half_light_radius,
    lateral_resolution as lateral_resolution,
    lenses_per_point as lenses_per_point,
    light as light,
    log_strehl as log_strehl,
    near_limit as near_limit,
    numerical_aperture as numerical_aperture,
    occupancy as occupancy,
    rms_width as rms_width,
    sag as sag,
    sensor_blur as sensor_blur,
    spacing as spacing,
    spot_width as spot_width,
    strehl as strehl,
    surface_radius as surface_radius,
    thickness as thickness,
    uncovered_distance as uncovered_distance,
    wavefront_error as wavefront_error,
    width_per_light as width_per_light,
)
