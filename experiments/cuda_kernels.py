"""Back-projection and its adjoint written by hand in CUDA, as a reference for the speed of `gs_jax` on GPUs.

The sums are those of `experiments.kernels`: bilinear, with the same envelope, without the rays that miss the sensor.
"""

from collections.abc import Callable

import numpy as np

from experiments.kernels import Geometry

SOURCE = r"""
// Calls `use(weight, pixel, down, right)` for each lens that sees a voxel.
template <typename Use>
__device__ void rays(const float2* lens, const float* magnification, const float* depth2, int d, int row,
                     int column, Use use) {
    float y = (row - (ROWS - 1) / 2.0f) * VOXEL, x = (column - (COLUMNS - 1) / 2.0f) * VOXEL;
    for (int k = 0; k < LENSES; k++) {
        float dx = lens[k].x - x, dy = lens[k].y - y, distance2 = dx * dx + dy * dy;
        if (distance2 >= LIMIT2) continue;
        float u = (lens[k].y + magnification[d] * dy) / PIXEL + (HEIGHT - 1) / 2.0f;
        float v = (lens[k].x + magnification[d] * dx) / PIXEL + (WIDTH - 1) / 2.0f;
        if (u < 0 || v < 0 || u > HEIGHT - 1 || v > WIDTH - 1) continue;
        int i = min(int(u), HEIGHT - 2), j = min(int(v), WIDTH - 2);
        float cos2 = depth2[d] / (depth2[d] + distance2), t = min((LIMIT2 - distance2) * SLOPE, 1.0f);
        use(cos2 * cos2 * t * t * (3 - 2 * t), size_t(i) * WIDTH + j, u - i, v - j);
    }
}

extern "C" __global__ void gather(const float2* lens, const float* magnification,
                                  const float* depth2, const float* __restrict__ image, float* volume) {
    int column = blockIdx.x * blockDim.x + threadIdx.x, row = blockIdx.y * blockDim.y + threadIdx.y, d = blockIdx.z;
    if (row >= ROWS || column >= COLUMNS) return;
    float total = 0;
    rays(lens, magnification, depth2, d, row, column, [&](float weight, size_t at, float down, float right) {
        float upper = image[at] + right * (image[at + 1] - image[at]);
        float lower = image[at + WIDTH] + right * (image[at + WIDTH + 1] - image[at + WIDTH]);
        total += weight * (upper + down * (lower - upper));
    });
    volume[(size_t(d) * ROWS + row) * COLUMNS + column] = total;
}

extern "C" __global__ void scatter(const float2* lens, const float* magnification,
                                   const float* depth2, const float* __restrict__ volume, float* image) {
    int column = blockIdx.x * blockDim.x + threadIdx.x, row = blockIdx.y * blockDim.y + threadIdx.y, d = blockIdx.z;
    if (row >= ROWS || column >= COLUMNS) return;
    float value = volume[(size_t(d) * ROWS + row) * COLUMNS + column];
    rays(lens, magnification, depth2, d, row, column, [&](float weight, size_t at, float down, float right) {
        float share = weight * value;
        atomicAdd(&image[at], share * (1 - down) * (1 - right));
        atomicAdd(&image[at + 1], share * (1 - down) * right);
        atomicAdd(&image[at + WIDTH], share * down * (1 - right));
        atomicAdd(&image[at + WIDTH + 1], share * down * right);
    });
}
"""


def cuda_kernels(geometry: Geometry, image: np.ndarray, volume: np.ndarray) -> tuple[Callable, Callable] | None:
    """Calls on the GPU, of the image and of the volume, that return CuPy arrays when they end; None without CuPy."""
    try:
        import cupy as cp  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    g = geometry
    numbers = {"LENSES": len(g.x), "ROWS": g.rows, "COLUMNS": g.columns, "HEIGHT": image.shape[0]}
    numbers |= {"WIDTH": image.shape[1], "VOXEL": f"{g.voxel_pitch}f", "PIXEL": f"{g.pixel_pitch}f"}
    numbers |= {"LIMIT2": f"{g.limit2}f", "SLOPE": f"{g.slope}f"}
    options = ("--std=c++17", "--use_fast_math", *(f"-D{name}={value}" for name, value in numbers.items()))
    module = cp.RawModule(code=SOURCE, options=options)
    lens = cp.asarray(np.column_stack([g.x, g.y]).astype(np.float32))
    depths = [cp.asarray(a.astype(np.float32)) for a in (g.magnification, g.depth2)]
    blocks, threads = (-(-g.columns // 32), -(-g.rows // 8), len(g.depth2)), (32, 8)

    def call(name, argument, result):
        module.get_function(name)(blocks, threads, (lens, *depths, argument, result))
        cp.cuda.get_current_stream().synchronize()
        return result

    on_device = cp.asarray(image), cp.asarray(volume)
    return (
        lambda: call("gather", on_device[0], cp.empty(volume.shape, cp.float32)),
        lambda: call("scatter", on_device[1], cp.zeros(image.shape, cp.float32)),
    )
