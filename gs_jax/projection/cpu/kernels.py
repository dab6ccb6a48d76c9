"""The three derivatives of the bilinear form on a processor, in numba: what `native` calls from compiled programs.

A kernel `(job, part)` computes one part of a result from the buffers of a job. Parts share nothing, so any thread may
take any of them, in any order, and the sums are the same. Arrays are float32 (an image may be of integers).

It is the arithmetic of `bilinear` in another order, for sixteen voxels at once. Voxels beyond a lens's field are not
visited. Along a row of voxels all rays of a lens meet the same two rows of the image, and sixteen of them a short
stretch of these, of which a processor with AVX-512 picks what each voxel needs, or each pixel (`picks`). Where it
cannot, or where rays are too far apart or too near, the two rows are blended first, and each voxel's two pixels are
copied as one number of 64 bits.
"""

import numpy as np

from . import gather as p, rows as r, shuffles as s, simd as v
from .rows import BUFFERS, FIRST, ONE, PARTS, PER_BUFFER, ZERO
from .simd import BOOL, WIDTH, carray

# Neighbouring voxels that reach the same pixels would wait for each other: they go to lines of their own, of which so
# many are enough.
LINES = 4
# Rows of a volume that are asked for before they are read: processors do not guess that a patch's next row is next.
AHEAD = 2


def gather(job_address, part, _):
    """Image to volume; a part is a band of rows of voxels."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables, at_tables, kind = r.tables(job), r.tables_of_columns(job), job[BUFFERS + PER_BUFFER * FIRST + 1]
    limit2, has_image, bytes_each = tables.numbers[1], kind != BOOL, r.bytes_of(kind)
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    tall, wide = r.image_shape(job, has_image)
    volume = r.numbers(job, FIRST + 1)
    rows, columns = volume.shape[1:]
    top, bottom = part * rows // job[PARTS], (part + 1) * rows // job[PARTS]
    # Sums are kept in rows that begin where lines of the cache do.
    stride = r.padded(columns) + WIDTH
    sums, lines = p.lines(depths * (bottom - top) * stride), p.lines(p.room(nx) + 2 * p.padded(nx) + wide + WIDTH)
    at_sums, at_lines = p.aligned(sums), p.aligned(lines)
    at_pairs = at_lines + 4 * p.room(nx)
    at_blended, here = at_pairs + 8 * p.padded(nx), p.place(at_lines, nx)
    x2 = p.floats(here.distance2, here.length)
    if not has_image:
        p.floats(at_pairs, 2 * here.length)[:] = ONE
    for lens in range(lenses):
        for d in range(depths):
            y_start, x_start = r.patch(tables, lens, d)
            first, last = max(top - y_start, 0), min(bottom - y_start, ny)
            if first >= last:
                continue
            shift = x_start % WIDTH
            p.fill(here, tables, at_tables, lens, d, shift, wide)
            size = p.windows(here, shift, nx, wide) if has_image else 0
            begin, end = shift, shift + nx
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                i, down = r.line(tables, lens, d, k, tall)
                above = r.address(job, FIRST) + bytes_each * i * wide
                below = above + bytes_each * wide
                ahead = bytes_each * wide * (r.line(tables, lens, d, min(k + 1, last - 1), tall)[0] - i)
                if size == 0 and has_image:
                    p.copied(job, FIRST, here, i, begin, end, ONE - down, down, at_blended, at_pairs)
                at_row = at_sums + 4 * ((d * (bottom - top) + y_start + k - top) * stride + x_start - shift)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    if size == 0:
                        before, after = s.load_even(at_pairs + 8 * c), s.load_odd(at_pairs + 8 * c)
                    else:
                        p.ask_for(here, kind, above + ahead, below + ahead, c)
                        before, after = p.picked_between(here, kind, above, below, down, size, c)
                    sample = before + v.load(here.right + 4 * c) * (after - before)
                    value = sample * r.weight(tables, d, y2 + v.load(here.distance2 + 4 * c))
                    v.store(at_row + 4 * c, v.load(at_row + 4 * c) + value)
    for d in range(depths):
        for k in range(bottom - top):
            volume[d, top + k] = p.floats(at_sums + 4 * (d * (bottom - top) + k) * stride, columns)
    r.keep((sums, lines))


def scatter(job_address, part, _):
    """Volume to image; a part is a band of rows of pixels."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables, at_tables = r.tables(job), r.tables_of_columns(job)
    limit2 = tables.numbers[1]
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    rows, columns = r.size(job, FIRST, 1), r.size(job, FIRST, 2)
    image = r.numbers(job, FIRST + 1)[:, :, 0]
    tall, wide = image.shape
    top, bottom = part * tall // job[PARTS], (part + 1) * tall // job[PARTS]
    image[top:bottom] = ZERO
    # What is another part's goes to a line that nobody reads.
    space, length = p.padded(nx), r.padded(wide + WIDTH)
    lines = p.lines(p.room(nx) + p.room_of_reaches(wide) + 3 * space + 3 * WIDTH + (1 + LINES) * length)
    at_columns = p.aligned(lines)
    at_reaches = at_columns + 4 * p.room(nx)
    at_pairs = at_reaches + 4 * p.room_of_reaches(wide)
    at_spare = at_pairs + 8 * space
    at_lines = at_spare + 4 * length
    at_edge = at_lines + 4 * LINES * length
    at_values = at_edge + 4 * WIDTH  # and 32 more
    here, reaches = p.place(at_columns, nx), p.place_reaches(at_reaches, wide)
    low, x2 = p.integers(here.pixel, here.length), p.floats(here.distance2, here.length)
    for lens in range(lenses):
        for d in range(depths):
            y_start, x_start = r.patch(tables, lens, d)
            shift = x_start % WIDTH
            y_pixel = tables.y_pixel[lens, d]
            first, last = r.first_below(y_pixel, bottom), r.first_below(y_pixel, top - 1)
            if first >= last:
                continue
            p.fill(here, tables, at_tables, lens, d, shift, wide)
            begin, end = r.chord(x2[: shift + nx], ZERO, limit2, shift, shift + nx)
            if begin == end:
                continue
            start, most = p.reached(reaches, here, begin, end, wide)
            many = p.lines_needed(here, begin, end)
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                i, down = r.line(tables, lens, d, k, tall)
                at_upper = r.address(job, FIRST + 1) + 4 * i * wide
                at_lower = at_upper + 4 * wide if i + 1 < bottom else at_spare
                at_upper = at_upper if i >= top else at_spare
                at_row = r.address(job, FIRST) + 4 * ((d * rows + y_start + k) * columns + x_start - shift)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    v.fetch(at_row + 4 * (AHEAD * columns + c))
                    voxels = r.voxels(at_row, c, columns - x_start + shift - c, at_edge)
                    value = voxels * r.weight(tables, d, y2 + v.load(here.distance2 + 4 * c))
                    if most > 0:
                        v.store(at_values + 4 * c, value)
                    else:
                        after = value * v.load(here.right + 4 * c)
                        s.store_pairs(at_pairs + 8 * c, value - after, after)
                left, right = np.int64(low[end - 1]), np.int64(low[begin]) + 1
                if most > 0:
                    for block in range((left - start) // WIDTH, (right - start) // WIDTH + 1):
                        j = 4 * (start + WIDTH * block)
                        spread = p.reaching(reaches, at_values, block, most)
                        v.store(at_upper + j, v.load(at_upper + j) + (ONE - down) * spread)
                        v.store(at_lower + j, v.load(at_lower + j) + down * spread)
                    for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                        v.store(at_values + 4 * c, v.zeros())
                    continue
                for c in range(begin, end):
                    v.add_two(at_pairs + 8 * c, at_lines + 4 * ((c & (many - 1)) * length + np.int64(low[c])))
                for block in range(left // WIDTH, right // WIDTH + 1):
                    j = 4 * min(WIDTH * block, wide - WIDTH)
                    spread = p.gathered(at_lines + j, many, 4 * length)
                    v.store(at_upper + j, v.load(at_upper + j) + (ONE - down) * spread)
                    v.store(at_lower + j, v.load(at_lower + j) + down * spread)
    r.keep((lines,))


def rays_bar(job_address, part, _):
    """Image and volume to what the rays change; a part is some of the lenses."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables, at_tables, kind = r.tables(job), r.tables_of_columns(job), job[BUFFERS + PER_BUFFER * FIRST + 1]
    limit2, has_image, bytes_each = tables.numbers[1], kind != BOOL, r.bytes_of(kind)
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    tall, wide = r.image_shape(job, has_image)
    rows, columns = r.size(job, FIRST + 1, 1), r.size(job, FIRST + 1, 2)
    y_fraction_bar, y_distance2_bar = r.numbers(job, FIRST + 2), r.numbers(job, FIRST + 3)
    x_fraction_bar, x_distance2_bar = r.numbers(job, FIRST + 4), r.numbers(job, FIRST + 5)
    parameters_bar = r.numbers(job, FIRST + 6)  # of each lens
    many, space, length = parameters_bar.shape[2], p.padded(nx), r.padded(wide + WIDTH)
    lines = p.lines(p.room(nx) + 6 * space + 2 * length + many * WIDTH + WIDTH)
    at_columns = p.aligned(lines)
    at_x_bar = at_columns + 4 * p.room(nx)
    at_x2_bar = at_x_bar + 4 * space
    # Of two pixels: their value, and how they change along y. An image of ones does not.
    at_pairs = at_x2_bar + 4 * space
    at_slopes = at_pairs + 8 * space
    at_line = at_slopes + 8 * space
    at_slope_line = at_line + 4 * length
    at_bars = at_slope_line + 4 * length
    at_edge = at_bars + 4 * many * WIDTH
    here = p.place(at_columns, nx)
    x2, x_bars = p.floats(here.distance2, here.length), p.floats(at_x_bar, 2 * space)
    bars = p.floats(at_bars, many * WIDTH)
    if not has_image:
        p.floats(at_pairs, 2 * space)[:] = ONE
    for lens in range(part * lenses // job[PARTS], (part + 1) * lenses // job[PARTS]):
        for d in range(depths):
            y_start, x_start = r.patch(tables, lens, d)
            shift = x_start % WIDTH
            p.fill(here, tables, at_tables, lens, d, shift, wide)
            size = p.windows(here, shift, nx, wide) if has_image else 0
            begin, end = shift, shift + nx
            x_bars[:], bars[:] = ZERO, ZERO
            for k in range(ny):
                y2 = tables.y_distance2[lens, d, k]
                y_fraction_bar[lens, d, k], y_distance2_bar[lens, d, k] = ZERO, ZERO
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2[: shift + nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = shift, shift + nx
                    continue
                i, down = r.line(tables, lens, d, k, tall)
                above = r.address(job, FIRST) + bytes_each * i * wide
                below = above + bytes_each * wide
                ahead = bytes_each * wide * (r.line(tables, lens, d, min(k + 1, ny - 1), tall)[0] - i)
                if size == 0 and has_image:
                    p.copied(job, FIRST, here, i, begin, end, ONE - down, down, at_line, at_pairs)
                    p.copied(job, FIRST, here, i, begin, end, -ONE, ONE, at_slope_line, at_slopes)
                at_row = r.address(job, FIRST + 1) + 4 * ((d * rows + y_start + k) * columns + x_start - shift)
                by_y, by_y2 = v.zeros(), v.zeros()
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    v.fetch(at_row + 4 * (AHEAD * columns + c))
                    voxels = r.voxels(at_row, c, columns - x_start + shift - c, at_edge)
                    fraction = v.load(here.right + 4 * c)
                    if size == 0:
                        before, after = s.load_even(at_pairs + 8 * c), s.load_odd(at_pairs + 8 * c)
                        before_by_y, after_by_y = s.load_even(at_slopes + 8 * c), s.load_odd(at_slopes + 8 * c)
                    else:
                        p.ask_for(here, kind, above + ahead, below + ahead, c)
                        before, after = p.picked(here, kind, above, size, c)
                        before_by_y, after_by_y = p.picked(here, kind, below, size, c)
                        before_by_y, after_by_y = before_by_y - before, after_by_y - after
                        before, after = before + down * before_by_y, after + down * after_by_y
                    along_x = after - before
                    sample = voxels * (before + fraction * along_x)
                    along_y = before_by_y + fraction * (after_by_y - before_by_y)
                    distance2 = y2 + v.load(here.distance2 + 4 * c)
                    weighted = voxels * r.weight(tables, d, distance2)
                    by_distance2 = sample * r.weight_slope(tables, d, distance2)
                    by_y, by_y2 = by_y + weighted * along_y, by_y2 + by_distance2
                    # Before the other stores, after which LLVM would compute the weight again.
                    r.add_parameters_bar(tables, d, distance2, sample, at_bars)
                    v.store(at_x_bar + 4 * c, v.load(at_x_bar + 4 * c) + weighted * along_x)
                    v.store(at_x2_bar + 4 * c, v.load(at_x2_bar + 4 * c) + by_distance2)
                y_fraction_bar[lens, d, k], y_distance2_bar[lens, d, k] = v.total(by_y), v.total(by_y2)
            for c in range(nx):
                x_fraction_bar[lens, d, c] = x_bars[shift + c]
                x_distance2_bar[lens, d, c] = x_bars[space + shift + c]
            for number in range(many):
                parameters_bar[lens, d, number] = bars[WIDTH * number : WIDTH * number + WIDTH].sum()
    r.keep((lines,))
