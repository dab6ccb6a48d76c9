"""The built-in design of the paper."""

from ..layouts import random_layout
from .design import Design
from .tables import ArrayTable, ImagingTable, LensTable, SensorTable


def geomscope(*, sensor_distance_mm: float = 5.8) -> Design:
    """The paper's microscope (Table 1), with a random layout of our own of the same statistics.

    *Host.*

    Parameters
    ----------
    sensor_distance_mm
        The paper prints about 4 mm, where a point at 20 mm is far out of focus: its thin-lens image forms at
        6.06 mm, and traced rays are sharpest at 5.8 mm.

    Examples
    --------
    >>> import gs_jax as gs
    >>> gs.geomscope().imaging.sensor_distance_mm, gs.geomscope(sensor_distance_mm=4.0).imaging.sensor_distance_mm
    (5.8, 4.0)
    """
    size = (20.0, 20.0)
    centers = random_layout(200, size, pitch=1.23, pitch_sd=0.09, diameter=2.0, seed=0).round(4)
    return Design(
        name="geomscope",
        sensor=SensorTable(pixel_pitch_um=4.5, shape=(5120, 5120)),
        lens=LensTable(radius_of_curvature_mm=2.0, refractive_index=1.43, aperture_diameter_mm=2.0),
        array=ArrayTable(size_mm=size, substrate_thickness_mm=1.0, centers_mm=tuple(map(tuple, centers.tolist()))),
        imaging=ImagingTable(
            sensor_distance_mm=sensor_distance_mm,
            working_distance_mm=(18.0, 30.0),
            wavelength_nm=520.0,
            field_radius_mm=3.0,
        ),
    )
