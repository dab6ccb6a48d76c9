"""How far what is made may be from what is designed: a table of numbers, in options or a TOML file."""

from pydantic import Field

from ..io.tables import Table


class Tolerances(Table):
    """Standard deviations of normal distributions, one draw a device; of each lens's position one a lens and axis.

    A drawing's "+- T" that nearly all parts keep is two standard deviations. Roughness and printed layers are not
    drawn: every device has them. The defaults are meant for silicone (PDMS) that is cast in a printed mold:

    - position: an assumption, between writers of masks (below 1 um) and printers of resin (10 um and more);
    - radius: silicones shrink by 1 to 4 % as they cure, by recipe and temperature; 1 % is what a mold that makes up for
      the mean leaves (and what a focal length measured to 1 % says);
    - conic: with 0.05 a lens of R = 2 mm falls 0.1 um less or more at 0.6 mm from its vertex;
    - tilt: 35 um from the middle of a plate of 20 mm to its edge, a speck of dust under a spacer;
    - index: PDMS changes by -4.5e-4 per kelvin, so 4 to 5 kelvins; tables of it differ by as much;
    - sensor distance: of a spacer that is measured with callipers;
    - roughness: lenses written with 12 bits of grey have 6 nm (doi:10.37188/lam.2022.047), plain layers tens;
    - layers and pixels: of a two-photon printer with grey levels; see `gs_jax.tolerances.surface`.
    """

    position_um: float = Field(
        default=3.0,
        ge=0,
        le=1000,
        title="each lens's place, along x and y",
        description="a number of um from 0 to 1000",
    )
    radius_percent: float = Field(
        default=1.0, ge=0, le=20, title="radius of curvature, of all lenses", description="a number of % from 0 to 20"
    )
    conic: float = Field(
        default=0.05, ge=0, le=2, title="conic constant, of all lenses", description="a number from 0 to 2"
    )
    index: float = Field(default=0.002, ge=0, le=0.1, title="refractive index", description="a number from 0 to 0.1")
    sensor_distance_um: float = Field(
        default=50.0, ge=0, le=2000, title="sensor distance v", description="a number of um from 0 to 2000"
    )
    tilt_deg: float = Field(
        default=0.2,
        ge=0,
        le=3,
        title="tilt of the array against the sensor, about x and y",
        description="a number of degrees from 0 to 3",
    )
    roughness_nm: float = Field(
        default=20.0,
        ge=0,
        le=2000,
        title="RMS roughness of the lenses, of every device",
        description="a number of nm from 0 to 2000",
    )
    layer_um: float = Field(
        default=0.1,
        ge=0,
        le=100,
        title="height of the printer's layers, of every device; 0 without any",
        description="a number of um from 0 to 100",
    )
    pixel_um: float = Field(
        default=5.0,
        ge=0.01,
        le=1000,
        title="width over which the printer smooths a layer's edge",
        description="a number of um from 0.01 to 1000",
    )
