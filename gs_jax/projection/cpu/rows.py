"""Rows of voxels in kernels: buffers, lens weights, the ends of a row, and the rows of pixels that it meets."""

from typing import NamedTuple

import numpy as np
from numba import types

from . import simd
from .simd import I64, WIDTH, inline, instruction

# A job is a list of 64-bit numbers: eight of its own, sixteen for arguments of XLA's functions, then address, type and
# three sizes of each buffer.
PARTS, FREE, ALLOCATE, OWN, BUFFERS, PER_BUFFER = 3, 5, 6, 8, 24, 5
# Buffers: numbers of the weight, its parameters, start, pixel, fraction and distance2 of y and of x, and what follows.
FIRST = 10
# What kernels return: `FAILED` if there is no memory for their scratch.
DONE, FAILED = 1, 0
ZERO, HALF, ONE, TWO, THREE, SIX, FAR = (np.float32(n) for n in (0, 0.5, 1, 2, 3, 6, 1e8))


class Tables(NamedTuple):
    """`rays.Rays`, and the numbers of the weight (`rays.weight_numbers`)."""

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


def _place(builder, buffer, number):
    return builder.add(builder.mul(buffer, I64(PER_BUFFER)), I64(BUFFERS + number))


def _entry(builder, job, buffer, number):
    return simd.load_number(builder, job, _place(builder, buffer, number))


def _array_of(dtype, axes):
    """Make a function of a job and a buffer that returns the buffer as an array of its first axes."""

    def emit(builder, job, buffer):
        return _entry(builder, job, buffer, 0), [_entry(builder, job, buffer, 2 + axis) for axis in range(axes)]

    return instruction(types.Array(dtype, axes, "C"))(emit)


# Not functions of numba, which would be compiled for each number that they are called with.
parts = instruction(types.int64)(lambda builder, job: simd.load_number(builder, job, I64(PARTS)))
address = instruction(types.int64)(lambda builder, job, buffer: _entry(builder, job, buffer, 0))
pixel_type = instruction(types.int64)(lambda builder, job, buffer: _entry(builder, job, buffer, 1))
size = instruction(types.int64)(
    lambda builder, job, buffer, axis: simd.load_number(builder, job, builder.add(_place(builder, buffer, 2), axis))
)
floats, integers = _array_of(types.float32, 3), _array_of(types.int32, 3)
float_rows, integer_rows = _array_of(types.float32, 2), _array_of(types.int32, 2)
float_list, integer_list = _array_of(types.float32, 1), _array_of(types.int32, 1)
padded = inline(lambda count: (count + WIDTH - 1) // WIDTH * WIDTH)
pixel_bytes = inline(lambda kind: 1 if kind == simd.UINT8 else 2 if kind == simd.UINT16 else 4)


@inline
def allocate(job, count):
    """The address of so many zeros (float32) from `align` on; 0 if there is no memory for them."""
    return simd.call(simd.load_long(job, ALLOCATE), count + WIDTH, 4, 0)


@inline
def free(job, at):
    """Free what `allocate` returned. Returns `DONE`."""
    simd.call(simd.load_long(job, FREE), at, 0, 0)
    return DONE


@inline
def fill(at, count, number):
    values = simd.floats(at, count)
    for n in range(count):
        values[n] = number


@inline
def read_tables(job):
    return Tables(
        float_list(job, 0), float_rows(job, 1),
        integer_rows(job, 2), integers(job, 3), floats(job, 4), floats(job, 5),
        integer_rows(job, 6), integers(job, 7), floats(job, 8), floats(job, 9),
    )  # fmt: skip


@inline
def patch(tables, lens, d, height, width):
    """First row and column of the voxels that a lens may see at a depth; all of them are in the volume."""
    d = min(d, tables.y_start.shape[1] - 1)
    last_row, last_column = height - tables.y_pixel.shape[2], width - tables.x_pixel.shape[2]
    row, column = np.int64(tables.y_start[lens, d]), np.int64(tables.x_start[lens, d])
    return min(max(row, 0), last_row), min(max(column, 0), last_column)


# These test `numbers[0]` before a ring's hole, so that LLVM makes a loop without branches for Eq. (2).
@inline
def _falloff(distance2, limit2, slope):
    t = simd.clip((limit2 - distance2) * slope)
    return t * t * (THREE - TWO * t)


@inline
def _falloff_slope(distance2, limit2, slope):
    t = simd.clip((limit2 - distance2) * slope)
    return t * (t - ONE) * (SIX * slope)


@inline
def _field(numbers, distance2):
    """The variable of a ring's polynomial, which would overflow beyond the ring, where it does not count."""
    return TWO * simd.clip(distance2 * (HALF * numbers[5]))


@inline
def weight(tables, d, distance2):
    """A lens's weight for sixteen voxels."""
    numbers, parameters = tables.numbers, tables.parameters
    share = _falloff(distance2, numbers[1], numbers[2])
    if numbers[0] == ZERO:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        return cos2 * cos2 * share
    if numbers[3] > ZERO:
        share = share - _falloff(distance2, numbers[3], numbers[4])
    t = _field(numbers, distance2)
    value = simd.zeros()
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
    t, value, slope = _field(numbers, distance2), simd.zeros(), simd.zeros()
    for power in range(parameters.shape[1] - 1, -1, -1):
        slope = slope * t + value
        value = value * t + parameters[d, power]
    return value * share_slope + slope * share * numbers[5]


@inline
def add_parameters_vjp(tables, d, distance2, factor, at_sums):
    """Add the derivatives of `weight` by its parameters, times a factor, to sixteen sums for each parameter."""
    numbers, parameters = tables.numbers, tables.parameters
    share = _falloff(distance2, numbers[1], numbers[2])
    if numbers[0] == ZERO:
        depth2 = parameters[d, 0] * parameters[d, 0]
        cos2 = depth2 / (depth2 + distance2)
        # By z': 4 C tan^2(theta) cos^2(theta) / z'.
        term = factor * share * cos2 * cos2 * cos2 * distance2 * (TWO * TWO / (depth2 * parameters[d, 0]))
        simd.store(at_sums, simd.load(at_sums) + term)
        return
    if numbers[3] > ZERO:
        share = share - _falloff(distance2, numbers[3], numbers[4])
    t, term = _field(numbers, distance2), factor * share
    for power in range(parameters.shape[1]):
        simd.store(at_sums + 64 * power, simd.load(at_sums + 64 * power) + term)
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
def hole_limit2(tables):
    """Squared distance below which the weight of a ring is zero; without a hole, negative."""
    numbers = tables.numbers
    return numbers[3] - ONE / numbers[4] if numbers[0] > ZERO and numbers[3] > ZERO else -ONE


@inline
def hole(x2, y2, limit2, begin, end, first, last):
    """The voxels of a row, from `begin` to `end`, in a ring's hole, from those of the row before: `(first, last)`."""
    if y2 >= limit2:
        return begin, begin
    if first >= last:
        first, last = begin, end
    return chord(x2, y2, limit2, first, last)


@inline
def pixel_and_fraction(pixel, fraction, pixels):
    """The pixel below a ray, which has a neighbour above it also at the sensor's edge."""
    low = min(max(np.int64(pixel), 0), pixels - 2)
    return low, fraction + np.float32(np.int64(pixel) - low)


@inline
def pixel_row(tables, lens, d, k, pixels):
    """The row of pixels that a row of voxels meets, and the fraction of the way to the next."""
    return pixel_and_fraction(tables.y_pixel[lens, d, k], tables.y_fraction[lens, d, k], pixels)


@inline
def blend(job, buffer, row, first, last, above, below, target):
    """The weighted sum of two neighbouring rows of the image, by blocks; the last block begins before its place."""
    columns, kind = size(job, buffer, 1), pixel_type(job, buffer)
    start = row * columns
    for block in range(first, last):
        j = min(WIDTH * block, columns - WIDTH)
        upper = simd.load_pixels(kind, address(job, buffer), start + j)
        lower = simd.load_pixels(kind, address(job, buffer), start + columns + j)
        simd.store(target + 4 * j, above * upper + below * lower)


@inline
def load_voxels(at_row, c, left, at_edge):
    """Sixteen voxels of a row from `c` on, of which `left` exist; the others are zero."""
    if left >= WIDTH:
        return simd.load(at_row + 4 * c)
    for n in range(WIDTH):
        simd.store_one(at_edge + 4 * n, simd.load_one(at_row + 4 * (c + n)) if n < left else ZERO)
    return simd.load(at_edge)


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
