"""Constraints: the common record, the library kinds, text expressions, and the proof of curvature."""

from consat.problem.constraints.library import KINDS, apart, box, constraint, displacement, expr, halfspace, near, outside, within
from consat.problem.constraints.record import OWNER, Constraint, Fixed, Number, Vector

__all__ = [
    "KINDS", "OWNER", "Constraint", "Fixed", "Number", "Vector",
    "apart", "box", "constraint", "displacement", "expr", "halfspace", "near", "outside", "within",
]  # fmt: skip
