"""AVX-512 gather: looks up sixteen pixels of a row per instruction, by the columns of a patch in blocks.

Blocks of sixteen columns begin where those of the volume do, `shift` columns before the patch that a lens can see. The
rays of a block meet pixels of a short piece of a row, its window. If it has at most 64 pixels, the pixel of each voxel
is permuted to it from there. For the adjoint, the voxels that reach sixteen pixels are permuted to these.
"""

from typing import NamedTuple

import numpy as np

from . import rows, simd
from .rows import FAR, ONE, ZERO
from .simd import WIDTH, floats, inline, integers

# The most voxels of a row that may reach a pixel, and the most pixels of a window.
MOST_TAPS, WIDEST = 4, 4 * WIDTH


class Columns(NamedTuple):
    """Addresses of numbers for each column of a patch, and of an integer for each block."""

    pixel: int  # the pixel at or below the ray (int32)
    right: int  # fraction of the way to the next
    distance2: int  # squared, from the lens's axis; `FAR` beside the patch
    window: int  # first pixel of a block's window (int32)
    length: int  # number of columns, with the padding of their blocks


# Where a line of the cache begins.
align = inline(lambda at: (at + 4 * WIDTH - 1) // (4 * WIDTH) * (4 * WIDTH))
# The most columns in a patch's blocks, and the numbers of `Columns` and `Taps`.
padded = inline(lambda nx: rows.padded(nx + WIDTH))
columns_size = inline(lambda nx: 4 * padded(nx))
taps_size = inline(lambda pixels: (3 + MOST_TAPS) * (rows.padded(pixels) + WIDTH))


@inline
def columns_at(at, nx):
    length = padded(nx)
    return Columns(at, at + 4 * length, at + 8 * length, at + 12 * length, length)


@inline
def fill_columns(columns, job, tables, lens, d, shift, pixels):
    """For a lens at a depth; pixels count from the first of the row."""
    nx = tables.x_pixel.shape[2]
    index = integers(columns.pixel, columns.length)
    right, x2 = floats(columns.right, columns.length), floats(columns.distance2, columns.length)
    for c in range(shift):
        index[c], right[c], x2[c] = 0, ZERO, FAR
    for c in range(shift + nx, columns.length):
        index[c], right[c], x2[c] = 0, ZERO, FAR
    row = 4 * (lens * tables.x_pixel.shape[1] + d) * nx
    at_pixel, at_fraction, at_distance2 = (
        rows.address(job, 7) + row,
        rows.address(job, 8) + row,
        rows.address(job, 9) + row,
    )
    for c in range(0, nx - WIDTH + 1, WIDTH):
        here = 4 * (shift + c)
        simd.clamp_pixels(at_pixel + 4 * c, at_fraction + 4 * c, pixels - 2, columns.pixel + here, columns.right + here)
        simd.store(columns.distance2 + here, simd.load(at_distance2 + 4 * c))
    for c in range(nx // WIDTH * WIDTH, nx):
        low, right[shift + c] = rows.pixel_and_fraction(
            tables.x_pixel[lens, d, c], tables.x_fraction[lens, d, c], pixels
        )
        index[shift + c], x2[shift + c] = low, tables.x_distance2[lens, d, c]


@inline
def set_windows(columns, shift, nx, pixels):
    """Count pixels from the first of each block's window; returns the windows' size, or 0 if they are too wide."""
    index, window = integers(columns.pixel, columns.length), integers(columns.window, columns.length)
    if not simd.HAS_AVX512:
        return 0
    size = 0
    for block in range(rows.padded(shift + nx) // WIDTH):
        first, last = max(WIDTH * block, shift), min(WIDTH * block + WIDTH, shift + nx) - 1
        size = max(size, np.int64(index[first]) - np.int64(index[last]) + 2)
    size = max(2 * WIDTH, rows.padded(size))
    if size > min(WIDEST, pixels):
        return 0
    for block in range(rows.padded(shift + nx) // WIDTH):
        last = min(WIDTH * block + WIDTH, shift + nx) - 1
        # Pixels fall with the columns; no window ends beyond the row.
        window[block] = min(np.int64(index[last]), pixels - size)
        simd.subtract(columns.pixel + 4 * WIDTH * block, np.int64(window[block]))
    return size


@inline
def _first_pixel(columns, c):
    return np.int64(simd.load_int(columns.window + 4 * (c // WIDTH)))


@inline
def gather_row(columns, kind, row, size, c):
    """The pixels of a row before and after sixteen rays."""
    first, places = _first_pixel(columns, c), columns.pixel + 4 * c
    one, two = simd.load_pixels(kind, row, first), simd.load_pixels(kind, row, first + WIDTH)
    if size == 2 * WIDTH:
        return simd.permute(places, 0, one, two), simd.permute(places, 1, one, two)
    three = simd.load_pixels(kind, row, first + 2 * WIDTH)
    four = simd.load_pixels(kind, row, first + 3 * WIDTH) if size == WIDEST else three
    return simd.permute_64(places, 0, one, two, three, four), simd.permute_64(places, 1, one, two, three, four)


@inline
def _blend(kind, above, below, down, first):
    return (ONE - down) * simd.load_pixels(kind, above, first) + down * simd.load_pixels(kind, below, first)


@inline
def gather_between(columns, kind, above, below, down, size, c):
    """The same between two rows."""
    first, places = _first_pixel(columns, c), columns.pixel + 4 * c
    one, two = _blend(kind, above, below, down, first), _blend(kind, above, below, down, first + WIDTH)
    if size == 2 * WIDTH:
        return simd.permute(places, 0, one, two), simd.permute(places, 1, one, two)
    three = _blend(kind, above, below, down, first + 2 * WIDTH)
    four = three
    if size == WIDEST:
        four = _blend(kind, above, below, down, first + 3 * WIDTH)
    return simd.permute_64(places, 0, one, two, three, four), simd.permute_64(places, 1, one, two, three, four)


@inline
def prefetch_rows(columns, kind, above, below, c):
    """Two rows of pixels that are read next; processors do not predict that."""
    first = rows.pixel_bytes(kind) * _first_pixel(columns, c)
    simd.prefetch(above + first)
    simd.prefetch(below + first)
    if rows.pixel_bytes(kind) == 4:
        simd.prefetch(above + first + 4 * WIDTH)
        simd.prefetch(below + first + 4 * WIDTH)


@inline
def copy_pairs(job, buffer, columns, row, begin, end, above, below, at_line, at_pairs):
    """The pixels before and after rays, one ray at a time, of the weighted sum of two rows."""
    low = integers(columns.pixel, columns.length)
    first, last = np.int64(low[end - 1]) // WIDTH, (np.int64(low[begin]) + 1) // WIDTH + 1
    rows.blend(job, buffer, row, first, last, above, below, at_line)
    for c in range(begin, end):
        simd.copy_two(at_line + 4 * np.int64(low[c]), at_pairs + 8 * c)


class Taps(NamedTuple):
    """Addresses of the voxels that reach each pixel of a row, and of their shares."""

    voxel: int  # the first voxel, counted from its block's window (int32)
    window: int  # first voxel of each block of pixels (int32)
    share: int  # of each voxel in the pixel, `length` apart
    number: int  # of voxels (int32)
    length: int


@inline
def taps_at(at, pixels):
    length = rows.padded(pixels) + WIDTH
    return Taps(at, at + 4 * length, at + 12 * length, at + 8 * length, length)


@inline
def fill_taps(taps, columns, begin, end, pixels):
    """For the columns from `begin` to `end`; returns the first pixel, and the most voxels of one or 0 if too many."""
    low = integers(columns.pixel, columns.length)
    start = np.int64(low[end - 1]) // WIDTH * WIDTH
    size = rows.padded(np.int64(low[begin]) + 2 - start)
    start = min(start, pixels - size)
    if not simd.HAS_AVX512 or start < 0:
        return start, 0
    most = _fill_two_taps(taps, columns, begin, end, start, size)
    return start, most if most > 0 else _fill_more_taps(taps, columns, begin, end, start, size)


@inline
def _fill_two_taps(taps, columns, begin, end, start, size):
    """Where rays are a pixel apart or more; returns 0 where they are not."""
    low, right = integers(columns.pixel, columns.length), floats(columns.right, columns.length)
    voxel, window = integers(taps.voxel, taps.length), integers(taps.window, taps.length)
    share, second = floats(taps.share, 2 * taps.length), taps.length
    for pixel in range(0, size, WIDTH):
        window[pixel // WIDTH] = 0
        simd.store(taps.share + 4 * pixel, simd.zeros())
        simd.store(taps.share + 4 * (second + pixel), simd.zeros())
    block, last = size, size + 1
    for c in range(begin, end):
        pixel = np.int64(low[c]) - start
        # Pixels rise, or are beyond the first and the last ray's, behind a lens or where the geometry is NaN.
        if pixel < 0 or pixel >= last or pixel + 1 >= size:
            return 0
        # The pixel above may be the one below the last ray.
        if pixel + 1 == last:
            share[second + last] = right[c]
        else:
            if (pixel + 1) // WIDTH != block:
                block = (pixel + 1) // WIDTH
                window[block] = c
            voxel[pixel + 1], share[pixel + 1] = c - window[block], right[c]
        if pixel // WIDTH != block:
            block = pixel // WIDTH
            window[block] = c
        voxel[pixel], share[pixel], last = c - window[block], ONE - right[c], pixel
    return 2


@inline
def _fill_more_taps(taps, columns, begin, end, start, size):
    low, right = integers(columns.pixel, columns.length), floats(columns.right, columns.length)
    voxel, number = integers(taps.voxel, taps.length), integers(taps.number, taps.length)
    share, window = floats(taps.share, MOST_TAPS * taps.length), integers(taps.window, taps.length)
    for pixel in range(0, size, WIDTH):
        simd.store(taps.number + 4 * pixel, simd.zeros())
        for tap in range(MOST_TAPS):
            simd.store(taps.share + 4 * (tap * taps.length + pixel), simd.zeros())
    most = 0
    for c in range(begin, end):
        for beside in range(2):
            pixel = np.int64(low[c]) + 1 - beside - start
            if pixel < 0 or pixel >= size:
                return 0
            others = np.int64(number[pixel])
            if others == 0:
                voxel[pixel] = c
            if others == MOST_TAPS or np.int64(voxel[pixel]) + others != c:
                return 0
            share[others * taps.length + pixel] = ONE - right[c] if beside else right[c]
            number[pixel], most = others + 1, max(most, others + 1)
    for block in range(size // WIDTH):
        # Voxels fall as pixels rise.
        lowest, highest = WIDTH * block, WIDTH * block + WIDTH - 1
        while lowest < highest and number[lowest] == 0:
            lowest += 1
        while lowest < highest and number[highest] == 0:
            highest -= 1
        window[block] = voxel[highest] if number[highest] > 0 else 0
        if voxel[lowest] + number[lowest] - voxel[highest] > 2 * WIDTH:
            return 0
        simd.subtract(taps.voxel + 4 * WIDTH * block, np.int64(window[block]))
    return most


@inline
def sum_taps(taps, at_values, block, most):
    """The sums of the voxels of a row at sixteen pixels."""
    at_window = at_values + 4 * np.int64(simd.load_int(taps.window + 4 * block))
    one, two = simd.load(at_window), simd.load(at_window + 4 * WIDTH)
    places, at_share, step = taps.voxel + 4 * WIDTH * block, taps.share + 4 * WIDTH * block, 4 * taps.length
    total = simd.load(at_share) * simd.permute(places, 0, one, two)
    total = total + simd.load(at_share + step) * simd.permute(places, 1, one, two)
    if most > 2:
        total = total + simd.load(at_share + 2 * step) * simd.permute(places, 2, one, two)
        total = total + simd.load(at_share + 3 * step) * simd.permute(places, 3, one, two)
    return total


@inline
def lines_needed(columns, begin, end):
    """The number of lines in which neighbouring voxels add to different addresses: the nearer their rays, the more."""
    low = integers(columns.pixel, columns.length)
    span = np.int64(low[begin]) - np.int64(low[end - 1])
    return 1 if span >= 2 * (end - begin) else 2 if span >= end - begin else 4


@inline
def take_sum(at_line, many, step):
    """The sum of sixteen pixels of the lines, which become zero."""
    total = simd.load(at_line)
    simd.store(at_line, simd.zeros())
    for line in range(1, many):
        total = total + simd.load(at_line + line * step)
        simd.store(at_line + line * step, simd.zeros())
    return total
