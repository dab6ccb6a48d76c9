"""What lets a processor pick sixteen pixels of a row at once: columns in blocks, and the pixels that each meets.

Blocks of sixteen columns begin where those of the volume do, `shift` columns before the patch that a lens can see. The
rays of a block meet pixels of a short stretch of a row, its window; if that is of at most 64 pixels, each voxel's is
picked by its place there. Backwards, the voxels that reach sixteen pixels are picked by theirs.
"""

from typing import NamedTuple

import numpy as np

from . import rows as r, shuffles as s, simd as v
from .rows import FAR, ONE, ZERO
from .simd import WIDTH, carray, inline

# How many voxels of a row a pixel may be reached by, and the most pixels of a window.
REACHES, WIDEST = 4, 4 * WIDTH


class Columns(NamedTuple):
    """Addresses of numbers for each column of a patch, and of an integer for each block."""

    pixel: int  # place of the pixel at or below the ray (int32)
    right: int  # how far it is to the next
    distance2: int  # squared, from the lens's axis; `FAR` beside the patch
    window: int  # first pixel of a block's window (int32)
    length: int  # columns, and what fills their blocks


@inline
def lines(count):
    """So many zeros from an address on that `aligned` gives."""
    return np.zeros(count + WIDTH, np.float32)


@inline
def aligned(numbers):
    return (np.int64(numbers.ctypes.data) + 4 * WIDTH - 1) // (4 * WIDTH) * (4 * WIDTH)


@inline
def padded(nx):
    """The most that a patch's blocks have room for."""
    return r.padded(nx + WIDTH)


@inline
def room(nx):
    """Floats that the columns need."""
    return 4 * padded(nx)


@inline
def place(at, nx):
    length = padded(nx)
    return Columns(at, at + 4 * length, at + 8 * length, at + 12 * length, length)


@inline
def integers(at, length):
    return carray(v.pointer(at), length, np.int32)


@inline
def floats(at, length):
    return carray(v.pointer(at), length, np.float32)


@inline
def fill(columns, tables, at_tables, lens, d, shift, pixels):
    """Of a lens at a depth; places count from the first pixel."""
    nx = tables.x_pixel.shape[2]
    index = integers(columns.pixel, columns.length)
    right, x2 = floats(columns.right, columns.length), floats(columns.distance2, columns.length)
    for c in range(shift):
        index[c], right[c], x2[c] = 0, ZERO, FAR
    for c in range(shift + nx, columns.length):
        index[c], right[c], x2[c] = 0, ZERO, FAR
    row = 4 * (lens * tables.x_pixel.shape[1] + d) * nx
    at_pixel, at_fraction, at_distance2 = at_tables
    for c in range(0, nx - WIDTH + 1, WIDTH):
        here = 4 * (shift + c)
        v.split(
            at_pixel + row + 4 * c, at_fraction + row + 4 * c, pixels - 2, columns.pixel + here, columns.right + here
        )
        v.store(columns.distance2 + here, v.load(at_distance2 + row + 4 * c))
    for c in range(nx // WIDTH * WIDTH, nx):
        low, right[shift + c] = r.pixel_and_fraction(tables.x_pixel[lens, d, c], tables.x_fraction[lens, d, c], pixels)
        index[shift + c], x2[shift + c] = low, tables.x_distance2[lens, d, c]


@inline
def windows(columns, shift, nx, pixels):
    """Let places count from where a block's window begins; returns its size, or zero where pixels cannot be picked."""
    index, window = integers(columns.pixel, columns.length), integers(columns.window, columns.length)
    if not s.PICKS:
        return 0
    size = 0
    for block in range(r.padded(shift + nx) // WIDTH):
        first, last = max(WIDTH * block, shift), min(WIDTH * block + WIDTH, shift + nx) - 1
        size = max(size, np.int64(index[first]) - np.int64(index[last]) + 2)
    size = max(2 * WIDTH, r.padded(size))
    if size > min(WIDEST, pixels):
        return 0
    for block in range(r.padded(shift + nx) // WIDTH):
        last = min(WIDTH * block + WIDTH, shift + nx) - 1
        # Pixels fall with the columns; no window ends beyond the row.
        window[block] = min(np.int64(index[last]), pixels - size)
        v.subtract(columns.pixel + 4 * WIDTH * block, np.int64(window[block]))
    return size


@inline
def picked(columns, kind, row, size, c):
    """The pixels of a row before and after sixteen rays."""
    first, places = np.int64(v.load_int(columns.window + 4 * (c // WIDTH))), columns.pixel + 4 * c
    one, two = v.load_pixels(kind, row, first), v.load_pixels(kind, row, first + WIDTH)
    if size == 2 * WIDTH:
        return s.pick(places, 0, one, two), s.pick(places, 1, one, two)
    three = v.load_pixels(kind, row, first + 2 * WIDTH)
    four = v.load_pixels(kind, row, first + 3 * WIDTH) if size == WIDEST else three
    return s.pick_of_64(places, 0, one, two, three, four), s.pick_of_64(places, 1, one, two, three, four)


@inline
def picked_between(columns, kind, above, below, down, size, c):
    """The same between two rows."""
    first, places, up = np.int64(v.load_int(columns.window + 4 * (c // WIDTH))), columns.pixel + 4 * c, ONE - down
    one = up * v.load_pixels(kind, above, first) + down * v.load_pixels(kind, below, first)
    two = up * v.load_pixels(kind, above, first + WIDTH) + down * v.load_pixels(kind, below, first + WIDTH)
    if size == 2 * WIDTH:
        return s.pick(places, 0, one, two), s.pick(places, 1, one, two)
    three = up * v.load_pixels(kind, above, first + 2 * WIDTH) + down * v.load_pixels(kind, below, first + 2 * WIDTH)
    four = three
    if size == WIDEST:
        four = up * v.load_pixels(kind, above, first + 3 * WIDTH) + down * v.load_pixels(kind, below, first + 3 * WIDTH)
    return s.pick_of_64(places, 0, one, two, three, four), s.pick_of_64(places, 1, one, two, three, four)


@inline
def ask_for(columns, kind, above, below, c):
    """Two rows of pixels that are picked next time; processors do not guess that."""
    first = r.bytes_of(kind) * np.int64(v.load_int(columns.window + 4 * (c // WIDTH)))
    v.fetch(above + first)
    v.fetch(below + first)
    if r.bytes_of(kind) == 4:
        v.fetch(above + first + 4 * WIDTH)
        v.fetch(below + first + 4 * WIDTH)


@inline
def copied(job, buffer, columns, row, begin, end, above, below, at_line, at_pairs):
    """Pixels before and after rays, of two rows that are weighted, one by one."""
    low = integers(columns.pixel, columns.length)
    first, last = np.int64(low[end - 1]) // WIDTH, (np.int64(low[begin]) + 1) // WIDTH + 1
    r.blend(job, buffer, row, first, last, above, below, at_line)
    for c in range(begin, end):
        v.copy_two(at_line + 4 * np.int64(low[c]), at_pairs + 8 * c)


class Reaches(NamedTuple):
    """Addresses of what says, for each pixel of a row that a patch's rays meet, which voxels reach it."""

    voxel: int  # place of the first of them (int32)
    window: int  # from which it is counted, for each block of pixels (int32)
    share: int  # of each of them, `length` apart: what it gives to the pixel
    number: int  # how many there are (int32)
    length: int


@inline
def room_of_reaches(pixels):
    return (3 + REACHES) * (r.padded(pixels) + WIDTH)


@inline
def place_reaches(at, pixels):
    length = r.padded(pixels) + WIDTH
    return Reaches(at, at + 4 * length, at + 12 * length, at + 8 * length, length)


@inline
def reached(reaches, columns, begin, end, pixels):
    """Of the columns from `begin` to `end`; returns the first pixel and the most voxels of one.

    That is zero where voxels cannot be picked.
    """
    low = integers(columns.pixel, columns.length)
    start = np.int64(low[end - 1]) // WIDTH * WIDTH
    size = r.padded(np.int64(low[begin]) + 2 - start)
    start = min(start, pixels - size)
    if not s.PICKS or start < 0:
        return start, 0
    most = _reached_by_two(reaches, columns, begin, end, start, size)
    return start, most if most > 0 else _reached_by_more(reaches, columns, begin, end, start, size)


@inline
def _reached_by_two(reaches, columns, begin, end, start, size):
    """Where rays are a pixel apart or more; zero where they are not."""
    low, right = integers(columns.pixel, columns.length), floats(columns.right, columns.length)
    voxel, window = integers(reaches.voxel, reaches.length), integers(reaches.window, reaches.length)
    share, second = floats(reaches.share, 2 * reaches.length), reaches.length
    for pixel in range(0, size, WIDTH):
        window[pixel // WIDTH] = 0
        v.store(reaches.share + 4 * pixel, v.zeros())
        v.store(reaches.share + 4 * (second + pixel), v.zeros())
    block, last = size, size + 1
    for c in range(begin, end):
        pixel = np.int64(low[c]) - start
        if pixel >= last:
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
def _reached_by_more(reaches, columns, begin, end, start, size):
    low, right = integers(columns.pixel, columns.length), floats(columns.right, columns.length)
    voxel, number = integers(reaches.voxel, reaches.length), integers(reaches.number, reaches.length)
    share, window = floats(reaches.share, REACHES * reaches.length), integers(reaches.window, reaches.length)
    for pixel in range(0, size, WIDTH):
        v.store(reaches.number + 4 * pixel, v.zeros())
        for each in range(REACHES):
            v.store(reaches.share + 4 * (each * reaches.length + pixel), v.zeros())
    most = 0
    for c in range(begin, end):
        for beside in range(2):
            pixel = np.int64(low[c]) + 1 - beside - start
            others = np.int64(number[pixel])
            if others == 0:
                voxel[pixel] = c
            if others == REACHES or np.int64(voxel[pixel]) + others != c:
                return 0
            share[others * reaches.length + pixel] = ONE - right[c] if beside else right[c]
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
        v.subtract(reaches.voxel + 4 * WIDTH * block, np.int64(window[block]))
    return most


@inline
def reaching(reaches, at_values, block, most):
    """What the voxels of a row give to sixteen pixels."""
    at_window = at_values + 4 * np.int64(v.load_int(reaches.window + 4 * block))
    one, two = v.load(at_window), v.load(at_window + 4 * WIDTH)
    places, at_share, step = reaches.voxel + 4 * WIDTH * block, reaches.share + 4 * WIDTH * block, 4 * reaches.length
    total = v.load(at_share) * s.pick(places, 0, one, two) + v.load(at_share + step) * s.pick(places, 1, one, two)
    if most > 2:
        total = total + v.load(at_share + 2 * step) * s.pick(places, 2, one, two)
        total = total + v.load(at_share + 3 * step) * s.pick(places, 3, one, two)
    return total


@inline
def lines_needed(columns, begin, end):
    """For neighbours to reach different pixels of a line: the nearer their rays, the more."""
    low = integers(columns.pixel, columns.length)
    span = np.int64(low[begin]) - np.int64(low[end - 1])
    return 1 if span >= 2 * (end - begin) else 2 if span >= end - begin else 4


@inline
def gathered(at_line, many, step):
    """The sum of sixteen pixels of the lines, which are emptied."""
    total = v.load(at_line)
    v.store(at_line, v.zeros())
    for line in range(1, many):
        total = total + v.load(at_line + line * step)
        v.store(at_line + line * step, v.zeros())
    return total
