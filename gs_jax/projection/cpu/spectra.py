"""Spectra over the angle of what lies about lenses, and their products with the stray light's table, in numba.

A kernel `(job, part)` as in `kernels`. The last axis is that of the lenses, a multiple of sixteen. Spectra are
`(2 harmonics, field, lens)`, of each harmonic the real part before the imaginary one. Two fields are transformed at
once, as the real and the imaginary part of one complex sequence.
"""

import numpy as np

from ...optics.field_varying import RADII
from . import rows, simd
from .fftconv import plane_bytes, transform, transform_back
from .gather import align
from .rows import HALF, ZERO
from .simd import WIDTH, inline

# Bytes of sixteen numbers.
_STEP = 4 * WIDTH
# Radii at once: a table's blocks have as many, and those that are zero are skipped.
ROWS = RADII


@inline
def _sum_entries(start, column, share, row, at, stride):
    """A row of a sparse matrix times sixteen columns, which begin at `at` and whose rows are `stride` bytes apart."""
    total = simd.zeros()
    for entry in range(np.int64(start[row]), np.int64(start[row + 1])):
        total = total + share[entry] * simd.load(at + stride * np.int64(column[entry]))
    return total


def to_spectra(job, part, _):
    """A sparse matrix to polar nodes `(angle, field)`, and their spectra; a part is some pairs of fields."""
    start, column, share = rows.integer_list(job, 0), rows.integer_list(job, 1), rows.float_list(job, 2)
    turns, order, side = rows.address(job, 3), rows.integer_list(job, 4), rows.size(job, 4, 0)
    at_x, stride, at_result = rows.address(job, 5), 4 * rows.size(job, 5, 1), rows.address(job, 6)
    fields, plane = rows.size(job, 6, 1), plane_bytes(side)
    memory = rows.allocate(job, plane // 2)
    if memory == 0:
        return rows.FAILED
    at = align(memory)
    pairs = (fields + 1) // 2
    for pair in range(part * pairs // rows.parts(job), (part + 1) * pairs // rows.parts(job)):
        # The last may have no second: it is its own.
        one, two = 2 * pair, min(2 * pair + 1, fields - 1)
        for lens in range(0, stride, _STEP):
            for angle in range(side):
                first = _sum_entries(start, column, share, angle * fields + one, at_x + lens, stride)
                second = _sum_entries(start, column, share, angle * fields + two, at_x + lens, stride)
                simd.store(at + _STEP * angle, first)
                simd.store(at + plane + _STEP * angle, second)
            transform(at, side, turns)
            for harmonic in range(side // 2 + 1):
                here, there = at + _STEP * order[harmonic], at + _STEP * order[(side - harmonic) % side]
                a, b, c, d = simd.load(here), simd.load(here + plane), simd.load(there), simd.load(there + plane)
                at_real = at_result + 2 * harmonic * fields * stride + lens
                at_imaginary = at_real + fields * stride
                simd.store(at_real + one * stride, HALF * (a + c))
                simd.store(at_imaginary + one * stride, HALF * (b - d))
                simd.store(at_real + two * stride, HALF * (b + d))
                simd.store(at_imaginary + two * stride, HALF * (c - a))
    return rows.free(job, memory)


def from_spectra(job, part, _):
    """The adjoint of `to_spectra`, with the transposed matrix; a part is some lenses."""
    start, column, share = rows.integer_list(job, 0), rows.integer_list(job, 1), rows.float_list(job, 2)
    turns, order, side = rows.address(job, 3), rows.integer_list(job, 4), rows.size(job, 4, 0)
    fields, stride, at_result = rows.size(job, 5, 1), 4 * rows.size(job, 5, 2), rows.address(job, 6)
    nodes, plane, blocks = rows.size(job, 6, 0), plane_bytes(side), stride // _STEP
    memory = rows.allocate(job, plane // 2 + side * fields * WIDTH)
    if memory == 0:
        return rows.FAILED
    at = align(memory)
    at_polar = at + 2 * plane
    for block in range(part * blocks // rows.parts(job), (part + 1) * blocks // rows.parts(job)):
        lens = _STEP * block
        for one in range(0, fields, 2):
            two = min(one + 1, fields - 1)
            for harmonic in range(side // 2 + 1):
                at_real = rows.address(job, 5) + 2 * harmonic * fields * stride + lens
                at_imaginary = at_real + fields * stride
                a, b = simd.load(at_real + one * stride), simd.load(at_imaginary + one * stride)
                c, d = simd.load(at_real + two * stride), simd.load(at_imaginary + two * stride)
                here, there = at + _STEP * order[harmonic], at + _STEP * order[(side - harmonic) % side]
                if here == there:
                    simd.store(here, a)
                    simd.store(here + plane, c)
                else:
                    simd.store(here, HALF * (a - d))
                    simd.store(here + plane, HALF * (b + c))
                    simd.store(there, HALF * (a + d))
                    simd.store(there + plane, HALF * (c - b))
            transform_back(at, side, turns)
            for angle in range(side):
                simd.store(at_polar + _STEP * (angle * fields + one), simd.load(at + _STEP * angle))
                simd.store(at_polar + _STEP * (angle * fields + two), simd.load(at + plane + _STEP * angle))
        for node in range(nodes):
            simd.store(at_result + node * stride + lens, _sum_entries(start, column, share, node, at_polar, _STEP))
    return rows.free(job, memory)


@inline
def _load_rows(at, step):
    """Eight rows of sixteen numbers."""
    a, b, c, d = simd.load(at), simd.load(at + step), simd.load(at + 2 * step), simd.load(at + 3 * step)
    at = at + 4 * step
    return a, b, c, d, simd.load(at), simd.load(at + step), simd.load(at + 2 * step), simd.load(at + 3 * step)


@inline
def _store_rows(at, step, values):
    a, b, c, d, e, f, g, h = values
    simd.store(at, a)
    simd.store(at + step, b)
    simd.store(at + 2 * step, c)
    simd.store(at + 3 * step, d)
    simd.store(at + 4 * step, e)
    simd.store(at + 5 * step, f)
    simd.store(at + 6 * step, g)
    simd.store(at + 7 * step, h)


@inline
def _add_scaled(values, at, x):
    """Add `x` to each of eight rows, times the number at `at` for it."""
    a, b, c, d, e, f, g, h = values
    a, b = a + simd.load_one(at) * x, b + simd.load_one(at + 4) * x
    c, d = c + simd.load_one(at + 8) * x, d + simd.load_one(at + 12) * x
    e, f = e + simd.load_one(at + 16) * x, f + simd.load_one(at + 20) * x
    g, h = g + simd.load_one(at + 24) * x, h + simd.load_one(at + 28) * x
    return a, b, c, d, e, f, g, h


@inline
def _sum_scaled(values, at):
    """The sum of eight rows, each times its number at `at`."""
    a, b, c, d, e, f, g, h = values
    first = simd.load_one(at) * a + simd.load_one(at + 4) * b + simd.load_one(at + 8) * c + simd.load_one(at + 12) * d
    last = (
        simd.load_one(at + 16) * e
        + simd.load_one(at + 20) * f
        + simd.load_one(at + 24) * g
        + simd.load_one(at + 28) * h
    )
    return first + last


@inline
def _list_nonzero(at, fields, listed):
    """Write the columns of a block that are not zero to a list; returns how many, of the mean lens and in all."""
    mean, count = 0, 0
    for column in range(0, 2 * fields, 2):
        # Two columns are sixteen numbers.
        if simd.any_nonzero(simd.load(at + 4 * ROWS * column)):
            listed[count], listed[count + 1] = column, column + 1
            count += 2
            mean += 2 if column + 1 < fields else 1 if column < fields else 0
    return mean, count


@inline
def _table_sizes(job):
    """Harmonics, radii, bytes between two of them, columns and fields of a table, and the depth that is asked for."""
    harmonics, radii, stride = rows.size(job, 3, 0) // 2, rows.size(job, 3, 1), 4 * rows.size(job, 3, 2)
    depth = np.int64(simd.load_int(rows.address(job, 1)))
    return harmonics, radii, stride, rows.size(job, 0, 1), rows.size(job, 4, 1), depth


def add_products(job, part, _):
    """Add each harmonic's products with its table to a sum; a part is some harmonics."""
    harmonics, radii, stride, columns, fields, depth = _table_sizes(job)
    memory = rows.allocate(job, columns)
    if memory == 0:
        return rows.FAILED
    listed = simd.integers(memory, columns)
    for harmonic in range(part * harmonics // rows.parts(job), (part + 1) * harmonics // rows.parts(job)):
        at_x = rows.address(job, 4) + 2 * harmonic * fields * stride
        for row in range(0, radii, ROWS):
            block = ((depth * harmonics + harmonic) * radii + row) // ROWS
            at_table = rows.address(job, 0) + 4 * ROWS * block * columns
            mean, count = _list_nonzero(at_table, fields, listed)
            at_sums = (2 * harmonic * radii + row) * stride
            for lens in range(0, stride, _STEP):
                excess = simd.load(rows.address(job, 2) + lens)
                for part_of in range(2):
                    at = at_sums + part_of * radii * stride + lens
                    values = _load_rows(rows.address(job, 3) + at, stride)
                    at_part = at_x + part_of * fields * stride + lens
                    for number in range(mean):
                        x = simd.load(at_part + np.int64(listed[number]) * stride)
                        values = _add_scaled(values, at_table + 4 * ROWS * np.int64(listed[number]), x)
                    for number in range(mean, count):
                        x = excess * simd.load(at_part + (np.int64(listed[number]) - fields) * stride)
                        values = _add_scaled(values, at_table + 4 * ROWS * np.int64(listed[number]), x)
                    _store_rows(rows.address(job, 5) + at, stride, values)
    return rows.free(job, memory)


def products_back(job, part, _):
    """The adjoint of `add_products`; a part is some harmonics."""
    harmonics, radii, stride, columns, fields, depth = _table_sizes(job)
    memory = rows.allocate(job, columns)
    if memory == 0:
        return rows.FAILED
    listed = simd.integers(memory, columns)
    for harmonic in range(part * harmonics // rows.parts(job), (part + 1) * harmonics // rows.parts(job)):
        at_x = rows.address(job, 4) + 2 * harmonic * fields * stride
        rows.fill(at_x, fields * stride // 2, ZERO)
        for row in range(0, radii, ROWS):
            block = ((depth * harmonics + harmonic) * radii + row) // ROWS
            at_table = rows.address(job, 0) + 4 * ROWS * block * columns
            mean, count = _list_nonzero(at_table, fields, listed)
            if count == 0:
                continue
            for lens in range(0, stride, _STEP):
                excess = simd.load(rows.address(job, 2) + lens)
                for part_of in range(2):
                    at = rows.address(job, 3) + ((2 * harmonic + part_of) * radii + row) * stride + lens
                    values, at_part = _load_rows(at, stride), at_x + part_of * fields * stride + lens
                    for number in range(mean):
                        at = at_part + np.int64(listed[number]) * stride
                        x = _sum_scaled(values, at_table + 4 * ROWS * np.int64(listed[number]))
                        simd.store(at, simd.load(at) + x)
                    for number in range(mean, count):
                        at = at_part + (np.int64(listed[number]) - fields) * stride
                        x = _sum_scaled(values, at_table + 4 * ROWS * np.int64(listed[number]))
                        simd.store(at, simd.load(at) + excess * x)
    return rows.free(job, memory)
