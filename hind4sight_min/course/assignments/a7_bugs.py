"""Find the silent bug

Code that crashes is harmless. A sign, an axis, a factor: training goes on, the loss falls, and the figures are a little
worse than they should be. You will not find it by reading; you find it by *measuring something that you know*.

Of twelve copies of the package each has one bug, and all that you are told is what its users notice. For each, write a
measurement: a function that builds a small input, asks the package, and returns one number; and the range in which this
number lies if the code is right. Good numbers to know are

- an identity: what goes there and back again is where it was; a rotation times its transpose is 1; what is not moved
  costs nothing;
- a symmetry: turned or shifted inputs give turned or shifted outputs;
- a limit or a count by hand: one point, one pixel, one cell;
- a derivative beside central differences;
- an invariant: what must not depend on something does not.

A range wide enough for rounding and narrow enough for the bug: in float64 an identity holds to 1e-12, in float32 to
1e-5. Use inputs where nothing vanishes or is symmetric by chance.
"""
from ..bugs import files  # noqa: F401
