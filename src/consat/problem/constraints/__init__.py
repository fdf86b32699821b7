"""What a constraint is: the record, the library kinds, and safe text expressions."""

from consat.problem.constraints.library import KINDS, apart, box, constraint, displacement, expr, halfspace, near, outside, within
from consat.problem.constraints.record import OWNER, Constraint, Fixed, Number, Vector

__all__ = [
    "KINDS", "OWNER", "Constraint", "Fixed", "Number", "Vector",
    "apart", "box", "constraint", "displacement", "expr", "halfspace", "near", "outside", "within",
]  # fmt: skip
