"""Back-projection written by hand in numba, as a reference for the speed of `gs_jax.backproject`.

Each kernel computes the same sum with the same envelope, bilinear, without the rays that miss the sensor. Pixels,
weights and sums are float32. Coordinates are float64, so that results agree with `gs_jax` to float32 rounding.
"""

from math import ceil, floor, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from gs_jax import Grid, Imager
from gs_jax.microscope.geometry import FALLOFF, field_limit

ZERO, ONE, TWO, THREE = np.float32(0), np.float32(1), np.float32(2), np.float32(3)
# With any other index type numba allows for negative indices, and does not vectorise.
INDEX = np.uint64
# Bands of rows, distributed over the threads.
BANDS = 16


class Geometry(NamedTuple):
    """An imager and a grid as plain numbers and arrays, mm."""

    x: np.ndarray  # of the lenses
    y: np.ndarray
    magnification: np.ndarray  # of the depths
    depth2: np.ndarray  # z'^2
    rows: int  # of voxels
    columns: int
    voxel_pitch: float
    pixel_pitch: float
    limit: float  # distance where the envelope ends
    limit2: np.float32
    slope: np.float32  # width of the envelope's falloff


def plain(imager: Imager, grid: Grid) -> Geometry:
    """Data for the kernels; lenses are sorted so that neighbours are close in memory."""
    x, y = np.asarray(imager.centers, np.float64).T
    band = np.floor(y / 1.5)
    order = np.lexsort((np.where(band % 2 == 0, x, -x), band))
    limit = field_limit(imager.field_radius)
    return Geometry(
        x=x[order],
        y=y[order],
        magnification=np.asarray(imager.magnification(grid.depths), np.float64),
        depth2=np.asarray(imager.reduced_depth(grid.depths), np.float32) ** 2,
        rows=grid.shape[0],
        columns=grid.shape[1],
        voxel_pitch=grid.pitch,
        pixel_pitch=imager.sensor.pixel_pitch,
        limit=limit,
        limit2=np.float32(limit**2),
        slope=np.float32(1 / (2 * FALLOFF * imager.field_radius**2)),
    )


@njit(fastmath=True, error_model="numpy", inline="always")
def _envelope(distance2, depth2, limit2, slope):
    cos2 = depth2 / (depth2 + distance2)
    t = min(max((limit2 - distance2) * slope, ZERO), ONE)
    return cos2 * cos2 * (t * t * (THREE - TWO * t))


@njit(parallel=True, fastmath=True, error_model="numpy")
def paper_loop(image, geometry):
    """The paper's loop: each voxel tests each lens, and adds the pixels of those that see it.

    Listing the lenses first and adding afterwards is faster than adding at once, because the test has no branch.
    """
    g = geometry
    height, width = image.shape
    lens_x, lens_y = g.x.astype(np.float32), g.y.astype(np.float32)
    volume = np.empty((g.depth2.size, g.rows, g.columns), np.float32)
    for plane_row in prange(g.depth2.size * g.rows):
        d, row = plane_row // g.rows, plane_row % g.rows
        depth2, magnification, limit2, slope = g.depth2[d], g.magnification[d], g.limit2, g.slope
        y = (row - (g.rows - 1) / 2) * g.voxel_pitch
        u_of_zero, scale = (height - 1) / 2 - magnification * y / g.pixel_pitch, (1 + magnification) / g.pixel_pitch
        near = np.empty(lens_x.size, np.int32)
        for column in range(g.columns):
            x = (column - (g.columns - 1) / 2) * g.voxel_pitch
            v_of_zero = (width - 1) / 2 - magnification * x / g.pixel_pitch
            x32, y32 = np.float32(x), np.float32(y)
            count = 0
            for lens in range(lens_x.size):
                dx, dy = lens_x[lens] - x32, lens_y[lens] - y32
                near[count] = lens
                count += dx * dx + dy * dy < limit2
            total = ZERO
            for k in range(count):
                lens = near[k]
                u, v = scale * g.y[lens] + u_of_zero, scale * g.x[lens] + v_of_zero
                if 0 <= u and u <= height - 1 and 0 <= v and v <= width - 1:
                    i, j = min(int(u), height - 2), min(int(v), width - 2)
                    down, right = np.float32(u - i), np.float32(v - j)
                    upper = image[i, j] + right * (image[i, j + 1] - image[i, j])
                    lower = image[i + 1, j] + right * (image[i + 1, j + 1] - image[i + 1, j])
                    dx, dy = lens_x[lens] - x32, lens_y[lens] - y32
                    weight = _envelope(dx * dx + dy * dy, depth2, limit2, slope)
                    total += weight * (upper + down * (lower - upper))
            volume[d, row, column] = total
    return volume


@njit(parallel=True, fastmath=True, error_model="numpy")
def _axis(centers, geometry, voxels, pixels):
    """Tables per lens: first voxel of the patch; pixel and two weights per depth; squared distance."""
    g = geometry
    size = min(voxels, int(2 * g.limit / g.voxel_pitch) + 1)
    lenses, depths = centers.size, g.depth2.size
    start = np.empty(lenses, np.int64)
    low = np.empty((lenses, depths, size), np.int32)
    weights = np.zeros((2, lenses, depths, size), np.float32)
    distance2 = np.empty((lenses, size), np.float32)
    for lens in prange(lenses):
        center = centers[lens]
        first = int(ceil((center - g.limit) / g.voxel_pitch + (voxels - 1) / 2))
        start[lens] = min(max(first, 0), voxels - size)
        for k in range(size):
            offset = center - (start[lens] + k - (voxels - 1) / 2) * g.voxel_pitch
            distance2[lens, k] = offset * offset
            for d in range(depths):
                pixel = (center + g.magnification[d] * offset) / g.pixel_pitch + (pixels - 1) / 2
                below = min(max(int(floor(pixel)), 0), pixels - 2)
                low[lens, d, k] = below
                if 0 <= pixel <= pixels - 1:
                    weights[0, lens, d, k] = 1 - (pixel - below)
                    weights[1, lens, d, k] = pixel - below
    return start, low, weights, distance2


def lens_patches(image, geometry: Geometry):
    """Visit a patch of voxels per lens; NumPy allocates the volume, because it requests huge pages."""
    volume = np.empty((len(geometry.depth2), geometry.rows, geometry.columns), np.float32)
    return _lens_patches(image, geometry, volume)


@njit(parallel=True, fastmath=True, error_model="numpy")
def _lens_patches(image, geometry, volume):
    """Our fastest hand-written kernel: threads share bands of rows, and lenses visit their voxels row by row.

    In a row all rays through a lens read the same two rows of the image. These are blended first, which leaves two
    pixels to gather per voxel instead of four. Loops are separate where that lets LLVM vectorise them (all but the
    gathers).
    """
    g = geometry
    y_start, y_low, y_weights, y_distance2 = _axis(g.y, g, g.rows, image.shape[0])
    x_start, x_low, x_weights, x_distance2 = _axis(g.x, g, g.columns, image.shape[1])
    size, limit2, slope = x_low.shape[2], g.limit2, g.slope
    for band in prange(BANDS):
        top, bottom = band * g.rows // BANDS, (band + 1) * g.rows // BANDS
        volume[:, top:bottom] = 0
        blended, sample = np.empty(image.shape[1], np.float32), np.empty(size, np.float32)
        for lens in range(g.x.size):
            first_row = max(top, y_start[lens])
            last_row = min(bottom, y_start[lens] + y_low.shape[2])
            middle = g.x[lens] / g.voxel_pitch + (g.columns - 1) / 2 - x_start[lens]
            for row in range(first_row, last_row):
                k = row - y_start[lens]
                y2 = y_distance2[lens, k]
                if y2 >= limit2:
                    continue
                half = sqrt(limit2 - y2) / g.voxel_pitch
                begin = INDEX(max(0, int(ceil(middle - half))))
                end = INDEX(max(0, min(size, int(floor(middle + half)) + 1)))
                if begin >= end:
                    continue
                many, first_column = end - begin, INDEX(x_start[lens]) + begin
                for d in range(g.depth2.size):
                    i, above, below = INDEX(y_low[lens, d, k]), y_weights[0, lens, d, k], y_weights[1, lens, d, k]
                    i1, depth2 = i + INDEX(1), g.depth2[d]
                    # The image is reversed: the last voxel reads the first pixel.
                    left = INDEX(x_low[lens, d, end - INDEX(1)])
                    width = INDEX(x_low[lens, d, begin]) + INDEX(2) - left
                    if width < INDEX(4) * many:
                        for j in range(width):
                            blended[j] = above * image[i, left + j] + below * image[i1, left + j]
                        for c in range(many):
                            j = INDEX(x_low[lens, d, begin + c]) - left
                            before, after = x_weights[0, lens, d, begin + c], x_weights[1, lens, d, begin + c]
                            sample[c] = before * blended[j] + after * blended[j + INDEX(1)]
                    else:  # sparse voxels on many pixels
                        for c in range(many):
                            j = INDEX(x_low[lens, d, begin + c])
                            j1 = j + INDEX(1)
                            before, after = x_weights[0, lens, d, begin + c], x_weights[1, lens, d, begin + c]
                            upper = before * image[i, j] + after * image[i, j1]
                            lower = before * image[i1, j] + after * image[i1, j1]
                            sample[c] = above * upper + below * lower
                    for c in range(many):
                        weight = _envelope(y2 + x_distance2[lens, begin + c], depth2, limit2, slope)
                        volume[d, INDEX(row), first_column + c] += weight * sample[c]
    return volume


def count_pairs(geometry: Geometry, sensor_shape: tuple[int, int]) -> int:
    """Number of voxel-lens pairs within the field whose ray meets the sensor."""
    g = geometry
    (_, _, y_weights, y2), (_, _, x_weights, x2) = (
        _axis(centers, g, voxels, pixels)
        for centers, voxels, pixels in zip((g.y, g.x), (g.rows, g.columns), sensor_shape, strict=True)
    )
    y_on, x_on = y_weights.max(0) > 0, x_weights.max(0) > 0
    pairs = 0
    for lens in range(len(g.x)):
        for d in range(len(g.depth2)):
            near = np.sort(x2[lens, x_on[lens, d]])
            pairs += int(np.searchsorted(near, g.limit2 - y2[lens, y_on[lens, d]]).sum())
    return pairs
