"""Imager: the map from a point to its image under each lens (Eqs. 1, 3).

Every length is in millimetres, the wavelength too. Lateral points are `(x, y)`, images are
`[row, column]`. The lateral frame is the whole sensor's: origin at its
centre, +x along increasing column, +y along increasing row. A depth `z > 0` is measured from the array's front, the
plate's plano face or, with the curved side in front, the lens vertices; the sensor's distance `v` is measured from
the array's back, the other of these two. Bare equation numbers mean the GEOMScope paper (Tian, Hu, Yang).
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..base.arrays import (
    FINITE,
    POSITIVE,
    Rule,
    array_namespace,
    as_float,
    as_float_or_none,
    check_fields,
    native,
    one_program,
)
from ..base.errors import input_error
from ..base.typing import Scalar, Scalars
from .grid import Sensor
from .lenses import MicrolensArray
from .media import (
    EmissionBand,
    Layers,
    Sample,
    check_room,
    depth_of_reduced,
    object_index,
    object_surface,
    reduced_distance,
    tilted_index,
    tilted_shortening,
)

# Limits of the wavelength, mm: others are in another unit.
SHORTEST, LONGEST = 1e-5, 0.1
_WAVELENGTH: Rule = (
    f"{SHORTEST:g} to {LONGEST:g} mm (520 nm are 520e-6 mm)",
    lambda x: (x >= SHORTEST) & (x <= LONGEST),
)

# By how much a rounding may put a depth before the object's medium, mm.
_ROUNDING = 1e-5

# Half the width of the envelope's falloff, as a fraction of the squared field radius: wide enough for a gradient, and
# so narrow that it adds 5 % to the radius within which lenses count.
FALLOFF = 0.1


def chief_ray(center, point, magnification):
    """Position on the sensor of the chief ray from `point` through the lens at `center`.

    `p = c + (c - q) v/z' = s_z c - M_z q` with `M_z = v/z'` (Eq. 3) and `s_z = 1 + M_z` (Eq. 1).
    It acts on each coordinate by itself, so arguments may be coordinates or vectors; all broadcast. It is the only
    implementation of the map.
    """
    return center + magnification * (center - point)


def envelope(distance_squared, reduced_depth, field_radius):
    """The envelope C: relative light of a point's image under a lens, 1 on the lens's axis.

    It is `cos(theta)^4` of the chief ray (Lambert's law and the foreshortened aperture; the paper cites the law without
    a formula) times a falloff at the field radius. The falloff is smooth, so that lens positions have gradients. It is
    1/2 at the field radius, where the paper takes the Strehl ratio to be half its peak, and its integral over the plane
    is exactly `A_e = pi field_radius^2`.

    Parameters
    ----------
    distance_squared
        Squared lateral distance of the point from the lens's axis, mm^2.
    reduced_depth
        `z'`, mm; broadcasts against `distance_squared`.
    field_radius
        `sqrt(A_e / pi)`, mm.
    """
    cos_squared = reduced_depth**2 / (reduced_depth**2 + distance_squared)
    return cos_squared**2 * falloff(distance_squared, field_radius)


def falloff(distance_squared, field_radius):
    """Falloff from 1 to 0 across the field radius, where it is 1/2; 0 from `field_limit` on."""
    outer = field_limit(field_radius) ** 2
    t = array_namespace(distance_squared).clip((outer - distance_squared) / (2 * FALLOFF * field_radius**2), 0, 1)
    return t * t * (3 - 2 * t)


def field_limit(field_radius):
    """Lateral distance from a lens's axis at which the envelope becomes zero, mm."""
    return field_radius * (1 + FALLOFF) ** 0.5


class Views(NamedTuple):
    """Views of points by lenses, one for each pair of a lens and a point.

    `spot`: where the chief ray meets the sensor, `(*view, 2)`, mm. `offset`: the point's `(x, y)` from the lens's axis,
    mm. `reduced_depth`: `z'`, mm, which broadcasts.
    """

    spot: Scalars
    offset: Scalars
    reduced_depth: Scalars


class Imager(eqx.Module):
    """A microlens array in front of a sensor, and the light: the one geometry of the package.

    *Differentiable.*

    Parameters
    ----------
    array, sensor
        What is imaged with.
    sensor_distance
        `v`, from the array's back to the sensor, mm: from the lens vertices, or from the plano face if that is behind.
    field_radius
        `sqrt(A_e / pi)`, mm: back-projection sums the lenses whose axes are so near to a voxel (paper, "Field of
        view"). They see points farther off, as the full model does. It decides array shapes, so it is a plain number.
    rotation
        Of the array about the frame's origin, radians, from +x toward +y.
    shift
        `(x, y)` of the array after the rotation, mm.
    wavelength
        Of the light, mm: 520e-6 for 520 nm.
    tilt
        Slopes `(x, y)` of the array's plane toward the object along +x and +y, about the point of the lens vertices'
        plane above the sensor's centre. None, the default, is an array parallel to the sensor.
    filters
        Layers on the object's side, from the array's front outward, in contact with it unless the first is of index 1.
        They tilt with the array.
    windows
        Layers on the sensor's side, from the sensor toward the array: the gap to the window, the window, a filter. The
        rest of `sensor_distance` is air. They are parallel to the sensor.
    sample
        The medium that holds the object. None, the default, is air. In contact with the array or its filters it tilts
        with them; one with a `surface` of its own is parallel to the sensor.
    band
        Wavelengths over which PSFs are means. None, the default, is light of `wavelength` alone.

    Raises
    ------
    ValueError
        If `field_radius` or `sensor_distance` is not positive, a number is not finite, `wavelength` is not one in mm,
        or layers are thicker than the room for them (traced values are not checked).

    Examples
    --------
    >>> scope = gs.Imager(array, gs.Sensor((200, 200), 0.02), sensor_distance=5.8, field_radius=3.0)
    >>> print(round(float(scope.magnification(20.0)), 3))  # v / z'
    0.28
    >>> scope.project(np.array([[0.0, 0.0, 20.0]])).shape  # where each lens images a point, (x, y) in mm
    (3, 1, 2)
    """

    array: MicrolensArray
    sensor: Sensor
    sensor_distance: Float[Array, ""] = eqx.field(converter=as_float)
    field_radius: float = eqx.field(static=True, converter=float)
    rotation: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    shift: Float[Array, "2"] = eqx.field(converter=as_float, default=(0.0, 0.0))
    wavelength: Float[Array, ""] = eqx.field(converter=as_float, default=520e-6)
    tilt: Float[Array, "2"] | None = eqx.field(converter=as_float_or_none, default=None)
    filters: Layers | None = None
    windows: Layers | None = None
    sample: Sample | None = None
    band: EmissionBand | None = None

    def __check_init__(self):
        if not self.field_radius > 0:
            raise ValueError(f"`field_radius` must be positive, got {self.field_radius}.")
        check_fields(self, sensor_distance=POSITIVE, rotation=FINITE, shift=FINITE, wavelength=_WAVELENGTH, tilt=FINITE)
        check_room(self.sensor_distance, self.filters, self.windows, self.sample, self.array.orientation)

    @property
    @one_program
    def centers(self) -> Scalars:
        """Lens vertices `(lens, 2)` in the sensor's frame, mm.

        Rotation only moves the centres, so the chief-ray map stays separable in x and y in the sensor's frame, which
        makes back-projection fast. So does a tilt, whose `heights` give each lens a magnification of its own.
        """
        centers = self.on_plate(self.array.centers)
        if self.tilt is None:
            return centers
        cosine = self._cosine
        return centers - (centers @ self.tilt)[:, None] * self.tilt[None] * (cosine**2 / (1 + cosine))

    @property
    @one_program
    def heights(self) -> Scalars:
        """Heights `(lens,)` of the vertices above `v`, toward the object, mm: 0 unless the array is tilted."""
        if self.tilt is None:
            return array_namespace(self.sensor_distance).zeros(len(self.array.centers), self.sensor_distance.dtype)
        return self._cosine * (self.on_plate(self.array.centers) @ self.tilt)

    def moved(self, origin: Float[Array, "2"]) -> "Imager":
        """The imager with another point `(x, y)` as the origin, mm; depths begin at the array's front there."""
        if self.tilt is None:
            return eqx.tree_at(lambda i: i.shift, self, self.shift - origin)
        height, cosine = origin @ self.tilt, self._cosine
        # In the plane the way to the point is longer.
        shift = self.shift - origin - self.tilt * (height * cosine / (1 + cosine))
        return eqx.tree_at(lambda i: i.shift, self, shift)._lifted(height)

    def level(self) -> tuple["Imager", Scalar | float]:
        """An array without tilt at the mean height of these lenses, and that height, mm.

        It images points that are nearer by the height as the tilted lenses do about their axes.
        """
        if self.tilt is None:
            return self, 0.0
        height = self.heights.mean()
        return self.at_height(height), height

    def at_height(self, height: Scalar) -> "Imager":
        """An array without tilt that images as lenses at this height do, mm; depths from it are less by the height."""
        return eqx.tree_at(lambda i: i.tilt, self._lifted(height), None, is_leaf=lambda leaf: leaf is None)

    def _lifted(self, height):
        """The imager farther from the sensor, and as much nearer to a sample with a surface of its own."""
        imager = eqx.tree_at(lambda i: i.sensor_distance, self, self.sensor_distance + height)
        if self.sample is None or self.sample.surface is None:
            return imager
        return eqx.tree_at(lambda i: i.sample.surface, imager, self.sample.surface - height)

    def on_plate(self, points: Float[Array | np.ndarray, "point 2"]) -> Scalars:
        """Points `(x, y)` of the array in the sensor's frame, after rotation and shift, before the tilt."""
        xp = array_namespace(self.rotation)
        cos, sin = xp.cos(self.rotation), xp.sin(self.rotation)
        x, y = points.T
        return xp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + self.shift[None]

    @property
    def _cosine(self):
        """Cosine of the tilt's angle."""
        assert self.tilt is not None
        return 1 / array_namespace(self.tilt).sqrt(1 + (self.tilt**2).sum())

    @one_program
    def reduced_depth(self, depth: Float[ArrayLike, "*batch"]) -> Scalars:
        """Reduced depth `z'` from the object to the lens vertices, mm.

        It is `z + t/n` with the plate in front, and `z` with the curved side in front; filters and the sample change
        it as `gs_jax.microscope.media` says. An imager of NumPy's numbers (`gs_jax.optics.raytrace.to_numpy`) gives
        NumPy's.
        """
        depth = array_namespace(self.sensor_distance).asarray(native(depth))
        return reduced_distance(depth, self.filters, self.sample) + self.array.reduced_thickness_front

    def depth_in_medium(self, depth: Float[ArrayLike, "*batch"]) -> Scalars:
        """Distance `n z'` that the lens vertices would have if all were of the object's medium, mm.

        A point that moves by `dz` moves by `dz / (n z')` of this; and a lens takes `1 / (n z')^2` of its light.
        """
        return object_index(self.sample) * self.reduced_depth(depth)

    @one_program
    def depth_of(self, reduced_depth: Scalars) -> Scalars:
        """Depth `z` of a reduced depth `z'`, mm."""
        return depth_of_reduced(reduced_depth - self.array.reduced_thickness_front, self.filters, self.sample)

    @property
    @one_program
    def sample_surface(self) -> Scalar:
        """Depth at which the object's medium begins, mm: the sample's surface, or where filters end.

        A depth within the sample, counted from its surface, is this much less than the depth `z`.
        """
        zero = array_namespace(self.sensor_distance).zeros((), self.sensor_distance.dtype)
        return zero + object_surface(self.filters, self.sample)

    @property
    @one_program
    def reduced_sensor_distance(self) -> Scalar:
        """Reduced distance `v'` from the lens vertices to the sensor: `v`, or `v + t/n` with the plate behind.

        Windows shorten it by `t (1 - 1/n)` each.
        """
        return self.sensor_distance + self._behind

    @one_program
    def sensor_distance_of(self, reduced_distance: Scalars) -> Scalars:
        """Sensor distance `v` of a reduced distance `v'`, mm."""
        return reduced_distance - self._behind

    @property
    def _behind(self):
        """`v' - v`."""
        plate = self.array.reduced_thickness_back
        return plate if self.windows is None else plate - self.windows.shortening

    @one_program
    def magnification(self, depth: Float[ArrayLike, "*batch"]) -> Scalars:
        """Lateral magnification `M_z = v'/z'` (Eq. 3)."""
        return self.reduced_sensor_distance / self.reduced_depth(depth)

    def magnifications(
        self, depth: Float[ArrayLike, " depth"], distortion: Scalars | float = 1.0
    ) -> Float[Array, "lens depth"]:
        """Magnification of each lens, `(v' + h) / (z' - h)` at the height `h`; one row unless the array is tilted."""
        magnification = (distortion * self.magnification(depth))[None]
        return magnification if self.tilt is None else self.magnification_of(magnification, self.heights[:, None])

    def magnification_of(self, magnification, height):
        """Magnification of a lens at a height, mm, from `M = v'/z'`: `(v' + h) / (z' - h)`; they broadcast.

        A medium of index n in contact with the array is thinner by `h` in front of the lens, and `z'` by `h / n`.
        """
        v = self.reduced_sensor_distance
        return magnification * (v + height) / (v - height / tilted_index(self.sample) * magnification)

    @one_program
    def axis_offset(self, depth: Float[ArrayLike, "*batch"]) -> Scalars:
        """Offset of a lens's axis, which is normal to the array, from its vertex at a depth, mm, `(*batch, 2)`."""
        return self._per_slope(-self._reduced_and_shortened(depth))

    def _reduced_and_shortened(self, depth):
        """`z'`, and by how much plates that tilt with the array make it less than the distance to the vertices, mm."""
        depth = array_namespace(self.sensor_distance).asarray(native(depth))
        plate = self.array.reduced_thickness_front * (self.array.refractive_index - 1)
        return self.reduced_depth(depth) + plate + tilted_shortening(depth, self.filters, self.sample)

    def _per_slope(self, length):
        """A length, mm, times the slopes of the array: `(*batch, 2)`, zero unless it is tilted."""
        xp = array_namespace(self.sensor_distance)
        tilt = xp.zeros(2, length.dtype) if self.tilt is None else self.tilt
        return xp.multiply.outer(length, tilt)

    def lean(self, depth: Float[ArrayLike, "*batch"], distortion: Scalars | float = 1.0) -> Scalars:
        """Displacement of points with which `chief_ray` gives the spots of a tilted array, mm, `(*batch, 2)`.

        Layers that tilt with the array displace rays by `t (1 - 1/n)` times its slopes; and spots are distorted about
        the image of the lens's axis, which is tilted.
        """
        return -self.axis_offset(depth) - self._per_slope(self.reduced_depth(depth) / distortion)

    @property
    @one_program
    def spot_displacement(self) -> Scalars:
        """Displacement of all spots by a plate behind the vertices that tilts with them, mm, `(2,)`."""
        return self._per_slope(self.array.reduced_thickness_back * (self.array.refractive_index - 1))

    @property
    @one_program
    def image_of_axis(self) -> Scalars:
        """Offset on the sensor of the image of a lens's axis from its vertex, mm, `(2,)`."""
        return self._per_slope(self.reduced_sensor_distance) + self.spot_displacement

    @one_program
    def scale(self, depth: Float[ArrayLike, "*batch"]) -> Float[Array, "*batch"]:
        """Scale of the array's pattern on the sensor, `s_z = (z' + v') / z'` (Eq. 1)."""
        return 1 + self.magnification(depth)

    @one_program
    def views(
        self,
        points: Float[Array | np.ndarray, "*#view 3"],
        lenses: Int[Array | np.ndarray, "*#view"],
        *,
        distortion: Scalars = 1.0,
    ) -> Views:
        """The map from points `(x, y, z)`, mm, to their spots under lenses.

        All code uses it but the kernels, whose separable form (`gs_jax.projection.rays`) is tested against it. `points`
        and `lenses` broadcast. An imager of NumPy's numbers gives NumPy's.

        Parameters
        ----------
        points
            In the sensor's frame.
        lenses
            Indices of `array.centers`.
        distortion
            Factor of the spot's distance from the image of the lens's axis: 1 for the chief ray, others for the core of
            a spot (`gs_jax.optics.psf_core`).
        """
        xp, points = array_namespace(self.sensor_distance), native(points)
        depth, lenses = points[..., 2], xp.asarray(lenses)
        magnification, reduced = distortion * self.magnification(depth), self.reduced_depth(depth)
        center, point = self.centers[lenses], points[..., :2]
        if self.tilt is None:
            return Views(chief_ray(center, point, magnification[..., None]), point - center, reduced)
        magnification = self.magnification_of(magnification, self.heights[lenses])
        spot = chief_ray(center, point + self.lean(depth, distortion), magnification[..., None])
        spot = spot + xp.broadcast_to(self.spot_displacement, spot.shape)
        return Views(spot, point - center - self.axis_offset(depth), reduced)

    def views_of_all(self, points: Float[Array | np.ndarray, "point 3"]) -> Views:
        """`views` of each point by each lens, `(lens, point)`."""
        return self.views(points[None], np.arange(len(self.array.centers))[:, None])

    def project(self, points: Float[Array | np.ndarray, "point 3"]) -> Scalars:
        """Spot of each point `(x, y, z)` under each lens, `(lens, point, 2)`, mm on the sensor."""
        return self.views_of_all(points).spot

    @one_program
    def brightness(self, views: Views) -> Scalars:
        """The envelope C of views."""
        return envelope((views.offset**2).sum(-1), views.reduced_depth, self.field_radius)


def check_beyond(imager: Imager, depths: Iterable[float] | Float[Array | np.ndarray, "..."], name: str) -> None:
    """Raise `InputError` unless depths, mm from the array, are where layers leave room for the object. Host code."""
    if imager.filters is None and imager.sample is None:
        return
    begins, nearest = float(imager.sample_surface), min(map(float, depths), default=math.inf)
    if nearest < begins - _ROUNDING:
        allowed = f"{begins:.6g} mm or more, where layers end and the object's medium begins"
        raise input_error(name, allowed, f"{nearest:.6g}")
