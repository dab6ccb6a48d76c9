"""The demonstration's scene: a word in each of three planes."""

import numpy as np
from jaxtyping import Float

from ...simulation.phantoms import letters

# What is written at which depth (mm), and where its middle is (mm).
WORDS = ((18.0, "near", (-4.0, -5.0)), (20.0, "focus", (0.0, 0.0)), (22.0, "far", (4.0, 5.0)))
_HEIGHT_MM = 2.5


def words(pitch: float) -> Float[np.ndarray, "emitter 4"]:
    """Emitters `(x, y, z, intensity)` of the words, `pitch` apart, mm."""
    each = [letters(word, depth=z, height=_HEIGHT_MM, pitch=pitch) + (x, y, 0, 0) for z, word, (x, y) in WORDS]
    return np.concatenate(each)
