"""The three derivatives of the bilinear form on a processor, in numba: what `native` calls from compiled programs.

A kernel `(job, part)` computes one part of a result from the buffers of a job. Parts share nothing, so any thread may
take any of them, in any order, and the sums are the same. Arrays are float32 (an image may be of integers).

It is the arithmetic of `bilinear` in another order. Voxels beyond a lens's field are not visited. Along a row of voxels
all rays of a lens meet the same two rows of the image, which are blended first; then each voxel needs two pixels, and
these are neighbours, which are copied as one number of 64 bits. The rest is done for sixteen voxels at once.
"""

import numpy as np

from . import rows as r, vectors as v
from .rows import BOOL, BUFFERS, FAR, FIRST, ONE, PARTS, PER_BUFFER, ZERO
from .vectors import WIDTH, carray

# Rows of a volume that are asked for before they are read: processors do not guess that a patch's next row is next.
AHEAD = 2


def gather(job_address, part, _):
    """Image to volume; a part is a band of rows of voxels."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables, has_image = r.tables(job), job[BUFFERS + PER_BUFFER * FIRST + 1] != BOOL
    limit2 = tables.numbers[1]
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    tall, wide = r.image_shape(job, has_image)
    volume = r.numbers(job, FIRST + 1)
    rows, columns = volume.shape[1:]
    top, bottom = part * rows // job[PARTS], (part + 1) * rows // job[PARTS]
    volume[:, top:bottom] = ZERO
    blended, edge = np.zeros(wide + WIDTH, np.float32), np.zeros(WIDTH, np.float32)
    low, right = np.zeros(nx, np.int64), np.zeros(r.padded(nx), np.float32)
    x2_padded = np.full(r.padded(nx), FAR, np.float32)
    x2 = x2_padded[:nx]
    pairs = np.ones(2 * r.padded(nx), np.float32)
    at_blended, at_edge, at_right = np.int64(blended.ctypes.data), edge.ctypes.data, np.int64(right.ctypes.data)
    at_x2, at_pairs = np.int64(x2_padded.ctypes.data), np.int64(pairs.ctypes.data)
    for lens in range(lenses):
        y_start, x_start = tables.y_start[lens], tables.x_start[lens]
        first, last = max(top - y_start, 0), min(bottom - y_start, ny)
        if first >= last:
            continue
        for d in range(depths):
            r.columns(tables, lens, d, wide, low, right, x2)
            begin, end = 0, nx
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2, y2, limit2, begin, end)
                if begin == end:
                    begin, end = 0, nx
                    continue
                if has_image:
                    i, down = r.line(tables, lens, d, k, tall)
                    one, two = low[end - 1] // WIDTH, (low[begin] + 1) // WIDTH + 1
                    r.blend(job, FIRST, i, one, two, ONE - down, down, at_blended)
                    for c in range(begin, end):
                        v.copy_two(at_blended + 4 * low[c], at_pairs + 8 * c)
                at_row = r.address(job, FIRST + 1) + 4 * ((d * rows + y_start + k) * columns + x_start)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    before, after = v.load_even(at_pairs + 8 * c), v.load_odd(at_pairs + 8 * c)
                    sample = before + v.load(at_right + 4 * c) * (after - before)
                    value = sample * r.weight(tables, d, y2 + v.load(at_x2 + 4 * c))
                    if x_start + c + WIDTH <= columns:
                        v.store(at_row + 4 * c, v.load(at_row + 4 * c) + value)
                    else:
                        v.store(at_edge, value)
                        for rest in range(columns - x_start - c):
                            volume[d, y_start + k, x_start + c + rest] += edge[rest]
    r.keep((blended, edge, right, x2, pairs))


def scatter(job_address, part, _):
    """Volume to image; a part is a band of rows of pixels."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables = r.tables(job)
    limit2 = tables.numbers[1]
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    rows, columns = r.size(job, FIRST, 1), r.size(job, FIRST, 2)
    image = r.numbers(job, FIRST + 1)[:, :, 0]
    tall, wide = image.shape
    top, bottom = part * tall // job[PARTS], (part + 1) * tall // job[PARTS]
    image[top:bottom] = ZERO
    # Neighbouring voxels that reach the same pixels would wait for each other: they go to lines of their own.
    length = 4 * r.padded(wide + WIDTH)
    lines, edge, spare = np.zeros(length, np.float32), np.zeros(WIDTH, np.float32), np.zeros(length, np.float32)
    at_spare = np.int64(spare.ctypes.data)
    low, target = np.zeros(nx, np.int64), np.zeros(nx, np.int64)
    right = np.zeros(r.padded(nx), np.float32)
    x2_padded = np.full(r.padded(nx), FAR, np.float32)
    x2 = x2_padded[:nx]
    pairs = np.zeros(2 * r.padded(nx), np.float32)
    at_lines, at_edge, at_right = np.int64(lines.ctypes.data), np.int64(edge.ctypes.data), np.int64(right.ctypes.data)
    at_x2, at_pairs = np.int64(x2_padded.ctypes.data), np.int64(pairs.ctypes.data)
    for lens in range(lenses):
        y_start, x_start = tables.y_start[lens], tables.x_start[lens]
        for d in range(depths):
            y_pixel = tables.y_pixel[lens, d]
            first, last = r.first_below(y_pixel, bottom), r.first_below(y_pixel, top - 1)
            if first >= last:
                continue
            span = np.int64(tables.x_pixel[lens, d, 0]) - np.int64(tables.x_pixel[lens, d, nx - 1])
            many = 1 if span >= 2 * nx else 2 if span >= nx else 4
            r.columns(tables, lens, d, wide, low, right, x2)
            for c in range(nx):
                target[c] = at_lines + (c & (many - 1)) * length + 4 * low[c]
            begin, end = 0, nx
            for k in range(first, last):
                y2 = tables.y_distance2[lens, d, k]
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2, y2, limit2, begin, end)
                if begin == end:
                    begin, end = 0, nx
                    continue
                at_row = r.address(job, FIRST) + 4 * ((d * rows + y_start + k) * columns + x_start)
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    v.fetch(at_row + 4 * (AHEAD * columns + c))
                    voxels = r.voxels(at_row, c, columns - x_start - c, at_edge)
                    value = voxels * r.weight(tables, d, y2 + v.load(at_x2 + 4 * c))
                    after = value * v.load(at_right + 4 * c)
                    v.store_pairs(at_pairs + 8 * c, value - after, after)
                for c in range(begin, end):
                    v.add_two(at_pairs + 8 * c, target[c])
                i, down = r.line(tables, lens, d, k, tall)
                # What is another part's goes to a line that nobody reads.
                at_upper = r.address(job, FIRST + 1) + 4 * i * wide
                at_lower = at_upper + 4 * wide if i + 1 < bottom else at_spare
                at_upper = at_upper if i >= top else at_spare
                for block in range(low[end - 1] // WIDTH, (low[begin] + 1) // WIDTH + 1):
                    j = 4 * min(WIDTH * block, wide - WIDTH)
                    spread = v.load(at_lines + j)
                    v.store(at_lines + j, v.zeros())
                    for line in range(1, many):
                        spread = spread + v.load(at_lines + line * length + j)
                        v.store(at_lines + line * length + j, v.zeros())
                    v.store(at_upper + j, v.load(at_upper + j) + (ONE - down) * spread)
                    v.store(at_lower + j, v.load(at_lower + j) + down * spread)
    r.keep((lines, edge, spare, right, x2, pairs))


def rays_bar(job_address, part, _):
    """Image and volume to what the rays change; a part is some of the lenses."""
    job = carray(v.pointer(job_address), 256, np.int64)
    tables, has_image = r.tables(job), job[BUFFERS + PER_BUFFER * FIRST + 1] != BOOL
    limit2 = tables.numbers[1]
    lenses, depths, ny = tables.y_pixel.shape
    nx = tables.x_pixel.shape[2]
    tall, wide = r.image_shape(job, has_image)
    rows, columns = r.size(job, FIRST + 1, 1), r.size(job, FIRST + 1, 2)
    y_fraction_bar, y_distance2_bar = r.numbers(job, FIRST + 2), r.numbers(job, FIRST + 3)
    x_fraction_bar, x_distance2_bar = r.numbers(job, FIRST + 4), r.numbers(job, FIRST + 5)
    parameters_bar = r.numbers(job, FIRST + 6)  # of each lens
    many = parameters_bar.shape[2]
    length = r.padded(wide + WIDTH)
    lines, edge = np.zeros(2 * length, np.float32), np.zeros(WIDTH, np.float32)
    low, x2 = np.zeros(nx, np.int64), np.full(r.padded(nx), FAR, np.float32)
    right, x_bars = np.zeros(r.padded(nx), np.float32), np.zeros(2 * r.padded(nx), np.float32)
    # Of two pixels: their value, and how they change along y. An image of ones does not.
    pairs, bars = np.ones(4 * r.padded(nx), np.float32), np.zeros((many, WIDTH), np.float32)
    pairs[2 * r.padded(nx) :] = ZERO
    at_lines, at_edge, at_right = np.int64(lines.ctypes.data), np.int64(edge.ctypes.data), np.int64(right.ctypes.data)
    at_x2, at_pairs, at_bars = np.int64(x2.ctypes.data), np.int64(pairs.ctypes.data), np.int64(bars.ctypes.data)
    at_x_bar, at_x2_bar = np.int64(x_bars.ctypes.data), np.int64(x_bars.ctypes.data) + 4 * r.padded(nx)
    at_slopes, at_slope_line = at_pairs + 8 * r.padded(nx), at_lines + 4 * length
    for lens in range(part * lenses // job[PARTS], (part + 1) * lenses // job[PARTS]):
        y_start, x_start = tables.y_start[lens], tables.x_start[lens]
        for d in range(depths):
            r.columns(tables, lens, d, wide, low, right, x2)
            begin, end = 0, nx
            x_bars[:], bars[:] = ZERO, ZERO
            for k in range(ny):
                y2 = tables.y_distance2[lens, d, k]
                y_fraction_bar[lens, d, k], y_distance2_bar[lens, d, k] = ZERO, ZERO
                if y2 >= limit2:
                    continue
                begin, end = r.chord(x2[:nx], y2, limit2, begin, end)
                if begin == end:
                    begin, end = 0, nx
                    continue
                if has_image:
                    i, down = r.line(tables, lens, d, k, tall)
                    one, two = low[end - 1] // WIDTH, (low[begin] + 1) // WIDTH + 1
                    r.blend(job, FIRST, i, one, two, ONE - down, down, at_lines)
                    r.blend(job, FIRST, i, one, two, -ONE, ONE, at_slope_line)
                    for c in range(begin, end):
                        v.copy_two(at_lines + 4 * low[c], at_pairs + 8 * c)
                        v.copy_two(at_slope_line + 4 * low[c], at_slopes + 8 * c)
                at_row = r.address(job, FIRST + 1) + 4 * ((d * rows + y_start + k) * columns + x_start)
                by_y, by_y2 = v.zeros(), v.zeros()
                for c in range(begin // WIDTH * WIDTH, end, WIDTH):
                    v.fetch(at_row + 4 * (AHEAD * columns + c))
                    voxels, fraction = r.voxels(at_row, c, columns - x_start - c, at_edge), v.load(at_right + 4 * c)
                    before, after = v.load_even(at_pairs + 8 * c), v.load_odd(at_pairs + 8 * c)
                    along_x = after - before
                    sample = voxels * (before + fraction * along_x)
                    before, after = v.load_even(at_slopes + 8 * c), v.load_odd(at_slopes + 8 * c)
                    along_y = before + fraction * (after - before)
                    distance2 = y2 + v.load(at_x2 + 4 * c)
                    weighted = voxels * r.weight(tables, d, distance2)
                    by_distance2 = sample * r.weight_slope(tables, d, distance2)
                    by_y, by_y2 = by_y + weighted * along_y, by_y2 + by_distance2
                    # Before the other stores, after which LLVM would compute the weight again.
                    r.add_parameters_bar(tables, d, distance2, sample, at_bars)
                    v.store(at_x_bar + 4 * c, v.load(at_x_bar + 4 * c) + weighted * along_x)
                    v.store(at_x2_bar + 4 * c, v.load(at_x2_bar + 4 * c) + by_distance2)
                y_fraction_bar[lens, d, k], y_distance2_bar[lens, d, k] = v.total(by_y), v.total(by_y2)
            for c in range(nx):
                x_fraction_bar[lens, d, c], x_distance2_bar[lens, d, c] = x_bars[c], x_bars[r.padded(nx) + c]
            for number in range(many):
                parameters_bar[lens, d, number] = bars[number].sum()
    r.keep((lines, edge, right, x2, pairs))
