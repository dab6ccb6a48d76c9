"""What programs that show volumes are told beside the voxels: a name, what is black and white, ImageJ's own words."""

from pathlib import Path

import numpy as np

# Percentiles of the values shown, of up to so many rows and columns.
_SHOWN, _SAMPLED = (1, 99.9), 512


def title(path: Path) -> str:
    """The name of a volume in a file."""
    return path.name.removesuffix(path.suffix).removesuffix(".ome")


def display_range(voxels: np.ndarray) -> tuple[float, float]:
    """What a viewer should show as black and white: few voxels are darker or brighter."""
    some = voxels[:, :: max(voxels.shape[1] // _SAMPLED, 1), :: max(voxels.shape[2] // _SAMPLED, 1)]
    for low, high in (np.percentile(some, _SHOWN), (voxels.min(), voxels.max())):
        if low < high:
            return float(low), float(high)
    return float(low), float(low) + 1


def imagej_description(voxels: np.ndarray, pitch_um: float, step_um: float, first_um: tuple[float, ...]) -> str:
    """ImageJ's description of a stack whose first voxel is at `(x, y, z)`; without a step it is one plane."""
    low, high = display_range(voxels)
    stack = f"images={len(voxels)}\nslices={len(voxels)}\n" if len(voxels) > 1 else ""
    spacing = f"spacing={step_um}\n" if step_um > 0 else ""
    # Where zero is, counted in voxels.
    sides = {"x": pitch_um, "y": pitch_um, "z": step_um}
    zero = "".join(f"{a}origin={-at / sides[a]:.6f}\n" for a, at in zip("xyz", first_um, strict=True) if sides[a])
    return f"ImageJ=1.54f\n{stack}unit=um\n{spacing}{zero}loop=false\nmin={low}\nmax={high}\n"
