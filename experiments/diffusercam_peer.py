"""LenslessPiCam's ADMM on the data of `diffusercam.py`, in an environment of its own (`pip install lensless torch`).

    PYTHON experiments/diffusercam_peer.py INPUT.npz OUTPUT.npz STEPS

NumPy, as its solver in PyTorch was slower on two cores; its own default weights. It imports nothing of this package.
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
