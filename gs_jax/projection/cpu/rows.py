"""What the kernels do along a row of voxels: buffers, weights, the row's ends, and the rows of pixels that it meets."""

from typing import NamedTuple

import numpy as np

from . import simd as v
from .simd import WIDTH, carray, inline

# A job is a list of 64-bit numbers: eight of its own, then address, type and three sizes of each buffer.
PARTS, BUFFERS, PER_BUFFER = 3, 8, 5
# Buffers: numbers of the weight, its parameters, start, pixel, fraction and distance2 of y and of x, and what follows.
FIRST = 10
ZERO, HALF, ONE, TWO, THREE, SIX, FAR = (np.float32(n) for n in (0, 0.5, 1, 2, 3, 6, 1e8))


class Tables(NamedTuple):
    """`rays.Rays`, and the numbers of `native`'s weight."""

    numbers: np.ndarray
    parameters: np.ndarray
    y_start: np.ndarray
    y_pixel: np.ndarray
    y_fraction: np.ndarray
    y_distance2: np.ndarray
    x_start: np.ndarray
    x_pixel: np.ndarray
    x_fraction: np.ndarray
    x_distance2: np.ndarray


@inline
def address(job, buffer):
    return job[BUFFERS + PER_BUFFER * buffer]


@inline
def size(job, buffer, axis):
    return job[BUFFERS + PER_BUFFER * buffer + 2 + axis]


@inline
def numbers(job, buffer):
    shape = (size(job, buffer, 0), size(job, buffer, 1), size(job, buffer, 2))
    return carray(v.pointer(address(job, buffer)), shape, np.float32)


@inline
def integers(job, buffer):
    shape = (size(job, buffer, 0), size(job, buffer, 1), size(job, buffer, 2))
    return carray(v.pointer(address(job, buffer)), shape, np.int32)


@inline
def tables_of_columns(job):
    """Addresses of the pixels, fractions and squared distances of x."""
    return address(job, 7), address(job, 8), address(job, 9)


@inline
def tables(job):
    return Tables(
        numbers(job, 0)[:, 0, 0], numbers(job, 1)[:, :, 0],
        integers(job, 2)[:, :, 0], integers(job, 3), numbers(job, 4), numbers(job, 5),
        integers(job, 6)[:, :, 0], integers(job, 7), numbers(job, 8), numbers(job, 9),
    )  # fmt: skip


@inline
def patch(tables, lens, d):
    """First row and column of the voxels that a lens may see at a depth."""
    d = min(d, tables.y_start.shape[1] - 1)
    return tables.y_start[lens, d], tables.x_start[lens, d]


@inline
def padded(count):
    return (count + WIDTH - 1) // WIDTH * WIDTH


@inline
def _falloff(distance2, limit2, slope):
    t = v.clipped((limit2 - distance2) * slope)
    return t * t * (THREE - TWO * t)


@inline
def _falloff_slope(distance2, limit2, slope):
    t = v.clipped((limit2 - distance2) * slope)
    return t * (t - ONE) * (SIX * slope)


@inline
def _field(numbers, distance2):
    """Of a ring; beyond it, where it does not count, a polynomial would overflow."""
    return TWO * v.clipped(distance2 * (HALF * numbers[5]))


@inline
def weight(tables, d, distance2):
    """What a lens gives to sixteen voxels."""
    numbers, parameters = tables.numbers, tables.parameters
    share = _falloff(distance2, numbers[1], numbers[2])
    if numbers[0] == ZERO:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        return cos2 * cos2 * share
    if numbers[3] > ZERO:
        share = share - _falloff(distance2, numbers[3], numbers[4])
    t = _field(numbers, distance2)
    value = v.zeros()
    for power in range(parameters.shape[1] - 1, -1, -1):
        value = value * t + parameters[d, power]
    return value * share


@inline
def weight_slope(tables, d, distance2):
    """The derivative of `weight` by the squared distance."""
    numbers, parameters = tables.numbers, tables.parameters
    share, share_slope = _falloff(distance2, numbers[1], numbers[2]), _falloff_slope(distance2, numbers[1], numbers[2])
    if numbers[0] == ZERO:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        return cos2 * cos2 * (share_slope - (TWO / depth2) * cos2 * share)
    if numbers[3] > ZERO:
        share = share - _falloff(distance2, numbers[3], numbers[4])
        share_slope = share_slope - _falloff_slope(distance2, numbers[3], numbers[4])
    t, value, slope = _field(numbers, distance2), v.zeros(), v.zeros()
    for power in range(parameters.shape[1] - 1, -1, -1):
        slope = slope * t + value
        value = value * t + parameters[d, power]
    return value * share_slope + slope * share * numbers[5]


@inline
def add_parameters_bar(tables, d, distance2, factor, at_bar):
    """What the weight's parameters change, times a factor, added to sixteen sums for each parameter."""
    numbers, parameters = tables.numbers, tables.parameters
    share = _falloff(distance2, numbers[1], numbers[2])
    if numbers[0] == ZERO:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        # By z': 4 C tan^2(theta) cos^2(theta) / z'.
        term = factor * share * cos2 * cos2 * cos2 * distance2 * (TWO * TWO / (depth2 * parameters[d, 0]))
        v.store(at_bar, v.load(at_bar) + term)
        return
    if numbers[3] > ZERO:
        share = share - _falloff(distance2, numbers[3], numbers[4])
    t, term = _field(numbers, distance2), factor * share
    for power in range(parameters.shape[1]):
        v.store(at_bar + 64 * power, v.load(at_bar + 64 * power) + term)
        term = term * t


@inline
def chord(x2, y2, limit2, begin, end):
    """The voxels of a row that are within the field, from those of the row before (or from all)."""
    size = x2.size
    while begin > 0 and y2 + x2[begin - 1] < limit2:
        begin -= 1
    while end < size and y2 + x2[end] < limit2:
        end += 1
    while begin < end and y2 + x2[begin] >= limit2:
        begin += 1
    while begin < end and y2 + x2[end - 1] >= limit2:
        end -= 1
    return begin, end


@inline
def pixel_and_fraction(pixel, fraction, pixels):
    """The pixel below a ray, with a neighbour above it also at the sensor's edge."""
    low = min(max(np.int64(pixel), 0), pixels - 2)
    return low, fraction + np.float32(np.int64(pixel) - low)


@inline
def line(tables, lens, d, k, pixels):
    """The row of pixels that a row of voxels meets, and how far it is to the next."""
    return pixel_and_fraction(tables.y_pixel[lens, d, k], tables.y_fraction[lens, d, k], pixels)


@inline
def blend(job, buffer, row, first, last, above, below, target):
    """Two neighbouring rows of the image, weighted, sixteen pixels a time; the last begin before their place."""
    columns, kind = size(job, buffer, 1), job[BUFFERS + PER_BUFFER * buffer + 1]
    start = row * columns
    for block in range(first, last):
        j = min(WIDTH * block, columns - WIDTH)
        upper = v.load_pixels(kind, address(job, buffer), start + j)
        lower = v.load_pixels(kind, address(job, buffer), start + columns + j)
        v.store(target + 4 * j, above * upper + below * lower)


@inline
def bytes_of(kind):
    return 1 if kind == v.UINT8 else 2 if kind == v.UINT16 else 4


@inline
def image_shape(job, has_image):
    # An image of ones is not read.
    return (size(job, FIRST, 0), size(job, FIRST, 1)) if has_image else (2, 2)


@inline
def voxels(at_row, c, left, at_edge):
    """Sixteen voxels of a row from `c` on, of which `left` are there; what follows is zero."""
    if left >= WIDTH:
        return v.load(at_row + 4 * c)
    for rest in range(WIDTH):
        v.store_one(at_edge + 4 * rest, v.load_one(at_row + 4 * (c + rest)) if rest < left else ZERO)
    return v.load(at_edge)


@inline
def first_below(pixel, limit):
    """The first voxel whose ray is at a pixel below the limit: the pixels fall."""
    low, high = 0, pixel.size
    while low < high:
        middle = (low + high) // 2
        if pixel[middle] < limit:
            high = middle
        else:
            low = middle + 1
    return low


@inline
def keep(arrays):
    """Numba frees an array after its last use, and to use its address is none: this is."""
    for array in arrays:
        array[0] = ZERO
