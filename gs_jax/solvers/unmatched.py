"""An operator whose way back is not its transpose."""

import equinox as eqx
import lineax as lx


class Unmatched(eqx.Module):
    """An operator with another one in the place of its transpose: `A.mv` is `forward`'s, `A.T.mv` is `back`'s.

    Enough of an operator for Richardson-Lucy, which comes to its end in fewer steps if what goes back is sharper than
    the adjoint (Zeng and Gullberg, IEEE Trans. Med. Imaging 19, 548, 2000).

    Parameters
    ----------
    forward, back
        From volumes to images, and the other way.
    squares
        What least squares invert, with its own transpose, in the place of both; by default `forward`.
    """

    forward: lx.AbstractLinearOperator
    back: lx.AbstractLinearOperator
    squares: lx.AbstractLinearOperator | None = None

    @property
    def T(self) -> "Unmatched":
        return Unmatched(self.back, self.forward)

    def mv(self, vector):
        return self.forward.mv(vector)

    def in_structure(self):
        return self.forward.in_structure()

    def out_structure(self):
        return self.forward.out_structure()
