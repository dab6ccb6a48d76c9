"""How far what is made may be from what is designed: a table of numbers, in options or a TOML file."""

from typing import Any

from pydantic import Field

from ...io.toml import Table


def _amount(default: float, most: float, unit: str, title: str, *, least: float = 0.0) -> Any:
    """A field of a number within bounds, with what the help and the error message say of it."""
    said = f"a number {f'of {unit} ' if unit else ''}from {least:g} to {most:g}"
    return Field(default=default, ge=least, le=most, title=title, description=said)


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
    - layers and pixels: of a two-photon printer with grey levels; see `gs_jax.apps.tolerance.surface`.
    """

    position_um: float = _amount(3.0, 1000.0, "um", "each lens's place, along x and y")
    radius_percent: float = _amount(1.0, 20.0, "%", "radius of curvature, of all lenses")
    conic: float = _amount(0.05, 2.0, "", "conic constant, of all lenses")
    index: float = _amount(0.002, 0.1, "", "refractive index")
    sensor_distance_um: float = _amount(50.0, 2000.0, "um", "sensor distance v")
    tilt_deg: float = _amount(0.2, 3.0, "degrees", "tilt of the array against the sensor, about x and y")
    roughness_nm: float = _amount(20.0, 2000.0, "nm", "RMS roughness of the lenses, of every device")
    layer_um: float = _amount(0.1, 100.0, "um", "height of the printer's layers, of every device; 0 without any")
    pixel_um: float = _amount(5.0, 1000.0, "um", "width over which the printer smooths a layer's edge", least=0.01)
