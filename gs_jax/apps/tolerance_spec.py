"""The tolerances of a device, as options and TOML files give them."""

from typing import Any

from pydantic import Field, ValidationError

from ..base.errors import InputError
from ..io.files import PathLike
from ..io.toml import Table, one_line, read_toml


def _field(default: float, most: float, unit: str, title: str, *, least: float = 0.0) -> Any:
    description = f"a number {f'of {unit} ' if unit else ''}from {least:g} to {most:g}"
    return Field(default=default, ge=least, le=most, title=title, description=description)


class ToleranceSpec(Table):
    """Standard deviations of normal distributions: one sample per device; of positions one per lens and axis.

    A tolerance "+- T" on a drawing, which nearly all parts keep, is two standard deviations. Roughness and printed
    layers are the same for every device. The defaults are meant for silicone (PDMS) that is cast in a printed mold:

    - position: an assumption, between writers of masks (below 1 um) and printers of resin (10 um and more);
    - radius: silicones shrink by 1 to 4 % as they cure, by recipe and temperature; 1 % remains in a mold that
      compensates the mean, or after a focal length was measured to 1 %;
    - conic: 0.05 changes the sag of a lens of R = 2 mm by 0.1 um at 0.6 mm from its vertex;
    - tilt: 35 um from the middle of a plate of 20 mm to its edge, a speck of dust under a spacer;
    - index: PDMS changes by -4.5e-4 per kelvin, so 4 to 5 kelvins; published values differ by as much;
    - sensor distance: a spacer that is measured with callipers;
    - roughness: lenses written with 12 bits of grey have 6 nm (doi:10.37188/lam.2022.047), plain layers tens;
    - layers and pixels: a two-photon printer with grey levels; see `gs_jax.apps.device_model`.
    """

    position_um: float = _field(3.0, 1000.0, "um", "position of each lens, along x and y")
    radius_percent: float = _field(1.0, 20.0, "%", "radius of curvature, of all lenses")
    conic: float = _field(0.05, 2.0, "", "conic constant, of all lenses")
    index: float = _field(0.002, 0.1, "", "refractive index")
    sensor_distance_um: float = _field(50.0, 2000.0, "um", "sensor distance v")
    tilt_deg: float = _field(0.2, 3.0, "degrees", "tilt of the array against the sensor, about x and y")
    roughness_nm: float = _field(20.0, 2000.0, "nm", "RMS roughness of the lenses, of every device")
    layer_um: float = _field(0.1, 100.0, "um", "height of the printer's layers, of every device; 0 without any")
    pixel_um: float = _field(5.0, 1000.0, "um", "width over which the printer smooths a layer's edge", least=0.01)


def read_tolerances(path: PathLike) -> ToleranceSpec:
    """Read a TOML file whose keys are the fields of `ToleranceSpec`; missing ones have their defaults.

    Raises `InputError` if the file cannot be read, or a key does not exist or has a wrong value.
    """
    try:
        return ToleranceSpec.model_validate(read_toml(path))
    except ValidationError as error:
        raise InputError(f"{one_line(error, ToleranceSpec, {})} ({path}).") from error
