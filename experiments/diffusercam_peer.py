"""Run LenslessPiCam's ADMM on the data of `diffusercam.py`, in a separate environment (`pip install lensless torch`).

    PYTHON experiments/diffusercam_peer.py INPUT.npz OUTPUT.npz STEPS

Uses its NumPy solver, which was faster than its PyTorch solver on two cores, with its default weights. The script
imports nothing of gs_jax.
"""

import sys
import time

import numpy as np
from lensless import ADMM  # pyright: ignore[reportMissingImports]


def main() -> None:
    given, steps = np.load(sys.argv[1]), int(sys.argv[3])
    solver = ADMM(given["psf"][None, :, :, None])
    solver.set_data(given["image"][None, :, :, None])
    solver._update(0)  # warm-up
    solver.reset()
    start = time.perf_counter()
    for number in range(steps):
        solver._update(number)
    seconds = time.perf_counter() - start
    np.savez(sys.argv[2], scene=np.maximum(solver._image_est[0, 0, :, :, 0], 0), seconds=seconds / steps)


if __name__ == "__main__":
    main()
