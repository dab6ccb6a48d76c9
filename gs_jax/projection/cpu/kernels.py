"""The three derivatives of the bilinear form as numba kernels, with the arithmetic of `bilinear` in another order.

A kernel `(job, part)` computes one part of a result from the buffers of a job and returns `rows.DONE`. Parts share
nothing, so any thread may take any of them, in any order, and the sums are the same. Arrays are float32 (an image may
be of integers). `dispatch` has checked their sizes; indices in tables are kept within them here, so that no kernel
writes elsewhere, whatever geometry the tables are of.

Sixteen voxels are computed at once; those beyond a lens's field are skipped. Along a row of voxels all rays of a lens
meet the same two rows of the image, and sixteen of them a short piece of these, from which AVX-512 gathers the pixel
of each voxel, or adds to each pixel. Without AVX-512, or where rays are too far apart or too near, the two rows are
blended first, and each voxel's two pixels are copied as one number of 64 bits.
"""

import numpy as np

from . import rows, simd
from .gather import (
    align,
    columns_at,
    columns_size,
    copy_pairs,
    fill_columns,
    fill_taps,
    gather_between,
    gather_row,
    lines_needed,
    padded,
    prefetch_rows,
    set_windows,
    sum_taps,
    take_sum,
    taps_at,
    taps_size,
)
from .rows import FIRST, ONE, ZERO
from .simd import BOOL, WIDTH, floats, integers

# Lines for neighbouring voxels that reach the same pixels, which would wait for each other; so many are enough.
LINES = 4
# Rows of a volume to prefetch; processors do not predict that a patch's next row is next.
AHEAD = 2


def gather(job, part, _):
    """Image to volume; a part is a band of rows of voxels."""
    tables, kind = rows.read_tables(job), rows.pixel_type(job, FIRST)
    limit2, has_image, bytes_each = tables.numbers[1], kind != BOOL, rows.pixel_bytes(kind)
    hole2 = rows.hole_limit2(tables)
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    # An image of ones is not read.
    tall, wide = (rows.size(job, FIRST, 0), rows.size(job, FIRST, 1)) if has_image else (2, 2)
    height, width = rows.size(job, FIRST + 1, 1), rows.size(job, FIRST + 1, 2)
    top, bottom = part * height // rows.parts(job), (part + 1) * height // rows.parts(job)
    # Sums are kept in rows that begin where lines of the cache do.
    stride = rows.padded(width) + WIDTH
    many = depths * (bottom - top) * stride
    memory = rows.allocate(job, many + columns_size(nx) + 2 * padded(nx) + wide + WIDTH)
    if memory == 0:
        return rows.FAILED
    at_sums = align(memory)
    at_lines = at_sums + 4 * many
    at_pairs = at_lines + 4 * columns_size(nx)
    at_blended, here = at_pairs + 8 * padded(nx), columns_at(at_lines, nx)
    x2 = floats(here.distance2, here.length)
    if not has_image:
        rows.fill(at_pairs, 2 * here.length, ONE)
    for lens in range(lenses):
        for d in range(depths):
            y_start, x_start = rows.patch(tables, lens, d, height, width)
            first, last = max(top - y_start, 0), min(bottom - y_start, ny)
            if first >= last:
                continue
            shift = x_start % WIDTH
            fill_columns(here, job, tables, lens, d, shift, wide)
            size = set_windows(here, shift, nx, wide) if has_image else 0
            begin, end, hole, beyond = shift, shift + nx, 0, 0
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = rows.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                hole, beyond = rows.hole(x2[: shift + nx], y2, hole2, begin, end, hole, beyond)
                i, down = rows.pixel_row(tables, lens, d, k, tall)
                above = rows.address(job, FIRST) + bytes_each * i * wide
                below = above + bytes_each * wide
                ahead = bytes_each * wide * (rows.pixel_row(tables, lens, d, min(k + 1, last - 1), tall)[0] - i)
                if size == 0 and has_image:
                    copy_pairs(job, FIRST, here, i, begin, end, ONE - down, down, at_blended, at_pairs)
                at_row = at_sums + 4 * ((d * (bottom - top) + y_start + k - top) * stride + x_start - shift)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    if c >= hole and c + WIDTH <= beyond:
                        continue
                    if size == 0:
                        before, after = simd.load_even(at_pairs + 8 * c), simd.load_odd(at_pairs + 8 * c)
                    else:
                        prefetch_rows(here, kind, above + ahead, below + ahead, c)
                        before, after = gather_between(here, kind, above, below, down, size, c)
                    sample = before + simd.load(here.right + 4 * c) * (after - before)
                    value = sample * rows.weight(tables, d, y2 + simd.load(here.distance2 + 4 * c))
                    simd.store(at_row + 4 * c, simd.load(at_row + 4 * c) + value)
    for d in range(depths):
        for k in range(bottom - top):
            row = floats(at_sums + 4 * (d * (bottom - top) + k) * stride, width)
            target = floats(rows.address(job, FIRST + 1) + 4 * (d * height + top + k) * width, width)
            for column in range(width):
                target[column] = row[column]
    return rows.free(job, memory)


def scatter(job, part, _):
    """Volume to image; a part is a band of rows of pixels."""
    tables = rows.read_tables(job)
    limit2, hole2 = tables.numbers[1], rows.hole_limit2(tables)
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    height, width = rows.size(job, FIRST, 1), rows.size(job, FIRST, 2)
    tall, wide = rows.size(job, FIRST + 1, 0), rows.size(job, FIRST + 1, 1)
    top, bottom = part * tall // rows.parts(job), (part + 1) * tall // rows.parts(job)
    rows.fill(rows.address(job, FIRST + 1) + 4 * top * wide, (bottom - top) * wide, ZERO)
    space, length = padded(nx), rows.padded(wide + WIDTH)
    many = columns_size(nx) + taps_size(wide) + 3 * space + 3 * WIDTH + (1 + LINES) * length
    memory = rows.allocate(job, many)
    if memory == 0:
        return rows.FAILED
    at_columns = align(memory)
    at_taps = at_columns + 4 * columns_size(nx)
    at_pairs = at_taps + 4 * taps_size(wide)
    at_spare = at_pairs + 8 * space  # a row of pixels that belongs to another part goes here and is not read
    at_lines = at_spare + 4 * length
    at_edge = at_lines + 4 * LINES * length
    at_values = at_edge + 4 * WIDTH  # and 32 more
    here, taps = columns_at(at_columns, nx), taps_at(at_taps, wide)
    low, x2 = integers(here.pixel, here.length), floats(here.distance2, here.length)
    for lens in range(lenses):
        for d in range(depths):
            y_start, x_start = rows.patch(tables, lens, d, height, width)
            shift = x_start % WIDTH
            y_pixel = tables.y_pixel[lens, d]
            first, last = rows.first_below(y_pixel, bottom), rows.first_below(y_pixel, top - 1)
            if first >= last:
                continue
            fill_columns(here, job, tables, lens, d, shift, wide)
            begin, end = rows.chord(x2[: shift + nx], ZERO, limit2, shift, shift + nx)
            if begin == end:
                continue
            start, most = fill_taps(taps, here, begin, end, wide)
            many, hole, beyond = lines_needed(here, begin, end), 0, 0
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = rows.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                hole, beyond = rows.hole(x2[: shift + nx], y2, hole2, begin, end, hole, beyond)
                # Blocks of voxels in the hole, whose pixels get no light.
                dark, light = rows.padded(hole), beyond // WIDTH * WIDTH
                i, down = rows.pixel_row(tables, lens, d, k, tall)
                at_upper = rows.address(job, FIRST + 1) + 4 * i * wide
                at_lower = at_upper + 4 * wide if i + 1 >= top and i + 1 < bottom else at_spare
                at_upper = at_upper if i >= top and i < bottom else at_spare
                at_row = rows.address(job, FIRST) + 4 * ((d * height + y_start + k) * width + x_start - shift)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    if most > 0 and c >= dark and c < light:
                        continue
                    simd.prefetch(at_row + 4 * (AHEAD * width + c))
                    voxels = rows.load_voxels(at_row, c, width - x_start + shift - c, at_edge)
                    value = voxels * rows.weight(tables, d, y2 + simd.load(here.distance2 + 4 * c))
                    if most > 0:
                        simd.store(at_values + 4 * c, value)
                    else:
                        after = value * simd.load(here.right + 4 * c)
                        simd.store_pairs(at_pairs + 8 * c, value - after, after)
                left, right = np.int64(low[end - 1]), np.int64(low[begin]) + 1
                if most > 0:
                    # Pixels between the first voxel beyond the hole and the last before it.
                    low_dark, high_dark = wide, 0
                    if dark < light and dark > begin and light < end:
                        low_dark, high_dark = np.int64(low[light]) + 2, np.int64(low[dark - 1])
                    for block in range((left - start) // WIDTH, (right - start) // WIDTH + 1):
                        if start + WIDTH * block >= low_dark and start + WIDTH * (block + 1) <= high_dark:
                            continue
                        j = 4 * (start + WIDTH * block)
                        spread = sum_taps(taps, at_values, block, most)
                        simd.store(at_upper + j, simd.load(at_upper + j) + (ONE - down) * spread)
                        simd.store(at_lower + j, simd.load(at_lower + j) + down * spread)
                    for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                        simd.store(at_values + 4 * c, simd.zeros())
                    continue
                for c in range(begin, end):
                    simd.add_two(at_pairs + 8 * c, at_lines + 4 * ((c & (many - 1)) * length + np.int64(low[c])))
                for block in range(left // WIDTH, right // WIDTH + 1):
                    j = 4 * min(WIDTH * block, wide - WIDTH)
                    spread = take_sum(at_lines + j, many, 4 * length)
                    simd.store(at_upper + j, simd.load(at_upper + j) + (ONE - down) * spread)
                    simd.store(at_lower + j, simd.load(at_lower + j) + down * spread)
    return rows.free(job, memory)


def rays_vjp(job, part, _):
    """Image and volume to the gradient by the rays; a part is some of the lenses."""
    tables, kind = rows.read_tables(job), rows.pixel_type(job, FIRST)
    limit2, has_image, bytes_each = tables.numbers[1], kind != BOOL, rows.pixel_bytes(kind)
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    tall, wide = (rows.size(job, FIRST, 0), rows.size(job, FIRST, 1)) if has_image else (2, 2)
    height, width = rows.size(job, FIRST + 1, 1), rows.size(job, FIRST + 1, 2)
    y_fraction_sums, y_distance2_sums = rows.floats(job, FIRST + 2), rows.floats(job, FIRST + 3)
    x_fraction_sums, x_distance2_sums = rows.floats(job, FIRST + 4), rows.floats(job, FIRST + 5)
    parameters_sums = rows.floats(job, FIRST + 6)  # of each lens
    many, space, length = parameters_sums.shape[2], padded(nx), rows.padded(wide + WIDTH)
    memory = rows.allocate(job, columns_size(nx) + 6 * space + 2 * length + many * WIDTH + WIDTH)
    if memory == 0:
        return rows.FAILED
    at_columns = align(memory)
    at_x_sums = at_columns + 4 * columns_size(nx)
    at_x2_sums = at_x_sums + 4 * space
    # Of two pixels: their values, and their derivatives along y, which are zero for an image of ones.
    at_pairs = at_x2_sums + 4 * space
    at_slopes = at_pairs + 8 * space
    at_line = at_slopes + 8 * space
    at_slope_line = at_line + 4 * length
    at_sums = at_slope_line + 4 * length
    at_edge = at_sums + 4 * many * WIDTH
    here = columns_at(at_columns, nx)
    x2, x_sums = floats(here.distance2, here.length), floats(at_x_sums, 2 * space)
    if not has_image:
        rows.fill(at_pairs, 2 * space, ONE)
    for lens in range(part * lenses // rows.parts(job), (part + 1) * lenses // rows.parts(job)):
        for d in range(depths):
            y_start, x_start = rows.patch(tables, lens, d, height, width)
            shift = x_start % WIDTH
            fill_columns(here, job, tables, lens, d, shift, wide)
            size = set_windows(here, shift, nx, wide) if has_image else 0
            begin, end = shift, shift + nx
            rows.fill(at_x_sums, 2 * space, ZERO)
            rows.fill(at_sums, many * WIDTH, ZERO)
            for k in range(ny):
                y2 = tables.y_distance2[lens, d, k]
                y_fraction_sums[lens, d, k], y_distance2_sums[lens, d, k] = ZERO, ZERO
                if y2 >= limit2:
                    continue
                begin, end = rows.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                i, down = rows.pixel_row(tables, lens, d, k, tall)
                above = rows.address(job, FIRST) + bytes_each * i * wide
                below = above + bytes_each * wide
                ahead = bytes_each * wide * (rows.pixel_row(tables, lens, d, min(k + 1, ny - 1), tall)[0] - i)
                if size == 0 and has_image:
                    copy_pairs(job, FIRST, here, i, begin, end, ONE - down, down, at_line, at_pairs)
                    copy_pairs(job, FIRST, here, i, begin, end, -ONE, ONE, at_slope_line, at_slopes)
                at_row = rows.address(job, FIRST + 1) + 4 * ((d * height + y_start + k) * width + x_start - shift)
                by_y, by_y2 = simd.zeros(), simd.zeros()
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    simd.prefetch(at_row + 4 * (AHEAD * width + c))
                    voxels = rows.load_voxels(at_row, c, width - x_start + shift - c, at_edge)
                    fraction = simd.load(here.right + 4 * c)
                    if size == 0:
                        before, after = simd.load_even(at_pairs + 8 * c), simd.load_odd(at_pairs + 8 * c)
                        before_by_y, after_by_y = simd.load_even(at_slopes + 8 * c), simd.load_odd(at_slopes + 8 * c)
                    else:
                        prefetch_rows(here, kind, above + ahead, below + ahead, c)
                        before, after = gather_row(here, kind, above, size, c)
                        before_by_y, after_by_y = gather_row(here, kind, below, size, c)
                        before_by_y, after_by_y = before_by_y - before, after_by_y - after
                        before, after = before + down * before_by_y, after + down * after_by_y
                    along_x = after - before
                    sample = voxels * (before + fraction * along_x)
                    along_y = before_by_y + fraction * (after_by_y - before_by_y)
                    distance2 = y2 + simd.load(here.distance2 + 4 * c)
                    weighted = voxels * rows.weight(tables, d, distance2)
                    by_distance2 = sample * rows.weight_slope(tables, d, distance2)
                    by_y, by_y2 = by_y + weighted * along_y, by_y2 + by_distance2
                    # Before the other stores, after which LLVM would compute the weight again.
                    rows.add_parameters_vjp(tables, d, distance2, sample, at_sums)
                    simd.store(at_x_sums + 4 * c, simd.load(at_x_sums + 4 * c) + weighted * along_x)
                    simd.store(at_x2_sums + 4 * c, simd.load(at_x2_sums + 4 * c) + by_distance2)
                y_fraction_sums[lens, d, k], y_distance2_sums[lens, d, k] = simd.total(by_y), simd.total(by_y2)
            for c in range(nx):
                x_fraction_sums[lens, d, c] = x_sums[shift + c]
                x_distance2_sums[lens, d, c] = x_sums[space + shift + c]
            for number in range(many):
                parameters_sums[lens, d, number] = simd.total(simd.load(at_sums + 4 * WIDTH * number))
    return rows.free(job, memory)
