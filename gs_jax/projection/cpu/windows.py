"""Windows of an image about lenses, as numba kernels.

A kernel `(job, part)` as in `kernels`. The number of lenses, the last axis, is a multiple of sixteen: `dispatch` adds
some that are beyond the image.
"""

import numpy as np

from . import rows, simd
from .gather import align
from .rows import ONE, ZERO
from .simd import WIDTH, inline

# Bytes of sixteen numbers, and of a square of them.
_STEP = 4 * WIDTH
_TILE = _STEP * WIDTH


@inline
def _within(row, column, side, tall, wide):
    """Whether a window, and the lines between whose pixels it lies, end before the image's spare lines."""
    return row >= 0 and column >= 0 and row + side + WIDTH < tall and column + side + WIDTH < wide


def read_windows(job, part, _):
    """Image to windows `(row, column, lens)`, interpolated linearly; a part is a band of their rows."""
    start, fraction = rows.integer_rows(job, 0), rows.float_rows(job, 1)
    tall, wide = rows.size(job, 2, 0), rows.size(job, 2, 1)
    side, lenses = rows.size(job, 3, 0), rows.size(job, 3, 2)
    memory = rows.allocate(job, 2 * WIDTH * WIDTH)
    if memory == 0:
        return rows.FAILED
    at_rows = align(memory)
    at_columns = at_rows + _TILE
    for block in range(0, lenses, WIDTH):
        for i in range(part * side // rows.parts(job), (part + 1) * side // rows.parts(job)):
            at_result = rows.address(job, 3) + 4 * (i * side * lenses + block)
            for j in range(0, side, WIDTH):
                for n in range(WIDTH):
                    row, column = np.int64(start[block + n, 0]), np.int64(start[block + n, 1])
                    down, right, value = fraction[block + n, 0], fraction[block + n, 1], simd.zeros()
                    if _within(row, column, side, tall, wide):
                        at = rows.address(job, 2) + 4 * ((row + i) * wide + column + j)
                        before = (ONE - down) * simd.load(at) + down * simd.load(at + 4 * wide)
                        after = (ONE - down) * simd.load(at + 4) + down * simd.load(at + 4 + 4 * wide)
                        value = before + right * (after - before)
                    simd.store(at_rows + _STEP * n, value)
                simd.transpose(at_rows, at_columns)
                for m in range(min(WIDTH, side - j)):
                    simd.store(at_result + 4 * (j + m) * lenses, simd.load(at_columns + _STEP * m))
    return rows.free(job, memory)


def add_windows(job, part, _):
    """The adjoint of `read_windows`; a part is a band of rows of the image."""
    start, fraction = rows.integer_rows(job, 0), rows.float_rows(job, 1)
    side, lenses = rows.size(job, 2, 0), rows.size(job, 2, 2)
    tall, wide = rows.size(job, 3, 0), rows.size(job, 3, 1)
    top, bottom = part * tall // rows.parts(job), (part + 1) * tall // rows.parts(job)
    rows.fill(rows.address(job, 3) + 4 * top * wide, (bottom - top) * wide, ZERO)
    # A row of each window, with zeros before and after it.
    length = rows.padded(side) + 3 * WIDTH
    memory = rows.allocate(job, WIDTH * (length + 2 * WIDTH))
    if memory == 0:
        return rows.FAILED
    at_columns = align(memory)
    at_rows = at_columns + _TILE
    at_lines = at_rows + _TILE + _STEP
    for block in range(0, lenses, WIDTH):
        first, last = side, 0
        for n in range(WIDTH):
            row, column = np.int64(start[block + n, 0]), np.int64(start[block + n, 1])
            if _within(row, column, side, tall, wide):
                first, last = min(first, top - 1 - row), max(last, bottom - row)
        for i in range(max(first, 0), min(last, side)):
            at_row = rows.address(job, 2) + 4 * (i * side * lenses + block)
            for j in range(0, side, WIDTH):
                for m in range(WIDTH):
                    exists = j + m < side
                    simd.store(
                        at_columns + _STEP * m, simd.load(at_row + 4 * (j + m) * lenses) if exists else simd.zeros()
                    )
                simd.transpose(at_columns, at_rows)
                for n in range(WIDTH):
                    simd.store(at_lines + 4 * (n * length + j), simd.load(at_rows + _STEP * n))
            for n in range(WIDTH):
                row, column = np.int64(start[block + n, 0]) + i, np.int64(start[block + n, 1])
                if not _within(row - i, column, side, tall, wide) or row + 1 < top or row >= bottom:
                    continue
                down, right = fraction[block + n, 0], fraction[block + n, 1]
                at_line, at_upper = at_lines + 4 * n * length, rows.address(job, 3) + 4 * (row * wide + column)
                at_lower = at_upper + 4 * wide
                for j in range(0, 4 * (side + 1), _STEP):
                    value = (ONE - right) * simd.load(at_line + j) + right * simd.load(at_line + j - 4)
                    if row >= top:
                        simd.store(at_upper + j, simd.load(at_upper + j) + (ONE - down) * value)
                    if row + 1 < bottom:
                        simd.store(at_lower + j, simd.load(at_lower + j) + down * value)
    return rows.free(job, memory)
