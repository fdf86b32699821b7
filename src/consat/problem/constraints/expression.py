"""Text expressions for ψ, e.g. ``2**2 - norm2(a2 - a3)``: a small language of differentiable arithmetic on positions.

==============  ===========================================================================================================
positions       an agent id stands for its position, a vector in R^d; an id that is not a name is quoted: ``'robot-1'``
components      ``a1.x``, ``a1.y``, ``a1.z``, or ``a1[0]``, ``a1[1]``, …; of any vector: ``(a1 - a2).x``
numbers         ``3``, ``0.5``, ``1e-3``, ``pi``
vectors         ``[1, 0.5 * a1.x]``: d entries, each a number
operators       ``+ - * / **`` and parentheses. Vectors add to vectors, and may be multiplied or divided by a number; only
                numbers have powers, and an exponent is a literal, e.g. ``2``, ``-1`` or ``(1/2)``
of vectors      ``norm2(v)`` = ‖v‖², ``norm(v)`` = ‖v‖ (gradient 0 at 0), ``dot(u, v)``, ``sum(v)``
of numbers      ``sqrt exp log sin cos tan asin acos atan sinh cosh tanh square``, ``atan2(y, x)``
==============  ===========================================================================================================

The value is a number, positive where the constraint holds. An expression reads at least one agent. All operations, except ``norm`` at 0,
are continuously differentiable inside their domain; therefore ``abs``, ``min``, ``max`` and comparisons are missing. ``t`` is the time in
seconds. The names of functions, ``pi`` and ``t`` take precedence over agents with the same id; quote the id to name the agent.

The text is never executed as Python. Python's parser yields a tree, `_Translator` accepts only what is listed above, and `Formula`
evaluates the result with `jax.numpy`. Literals are folded and then taken out of the tree, so constraints with different agents and numbers
share one `Formula` and hence one family (see `consat.problem.constraints.record`).
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
import re
import reprlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import accumulate
from typing import Any, Final, NamedTuple, NoReturn

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from consat.errors import InvalidExpression, counted
from consat.problem.constraints.functions import safe_norm

MAX_LENGTH: Final = 2000
"""Largest length of an expression, in characters."""
MAX_DEPTH: Final = 50
"""Largest nesting depth."""
MAX_NODES: Final = 400
"""Largest number of numbers, positions and operations."""
MAX_EXPONENT: Final = 16
"""Largest size of an exponent."""
MAX_NUMBER: Final = 1e15
"""Largest size of a literal number."""


class _Operation(NamedTuple):
    """Operand types and evaluation of an operation.

    Attributes:
        takes: types of the operands as a regular expression: p for a number, v for a vector. Its first letter is the type that an error
            message asks for.
        apply: from the values of the operands, and the details of the node, to the value.
        fold: the same for literal numbers as Python floats; None if literals are not folded.
        wrong: error message for operands of other types, if the operation is not a function.
    """

    takes: str
    apply: Callable[..., Array]
    fold: Callable[..., Any] | None = None
    wrong: str = ""


_FUNCTIONS: Final[Mapping[str, _Operation]] = {
    "norm2": _Operation("v", lambda v: jnp.sum(v**2)),
    "norm": _Operation("v", safe_norm),
    "dot": _Operation("vv", jnp.dot),
    "sum": _Operation("v", jnp.sum),
    **{
        name: _Operation("p", getattr(jnp, name), getattr(math, name))
        for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
    },
    "square": _Operation("p", jnp.square, lambda p: p * p),
    "atan2": _Operation("pp", jnp.atan2, math.atan2),
}
_MIXED: Final = "a number and a vector cannot be added or subtracted; take a1.x or norm2(v), or write the number as a vector"
_OPERATIONS: Final[Mapping[str, _Operation]] = {
    **_FUNCTIONS,
    "+": _Operation("p*|v*", lambda *terms: reduce(operator.add, terms), operator.add, _MIXED),
    "-": _Operation("p|v", operator.neg, operator.neg),
    "*": _Operation("p.|.p", operator.mul, operator.mul, "two vectors cannot be multiplied; their scalar product is dot(u, v)"),
    "/": _Operation(".p", operator.truediv, operator.truediv, "division by a vector; divide by a number, such as norm(v)"),
    "**": _Operation("p", operator.pow, math.pow, "a vector has no powers; the square of its length is norm2(v)"),
    "component": _Operation("v", operator.getitem, None, "only a vector has components, but this is a number"),
    "vector": _Operation("p*", lambda *entries: jnp.stack(entries), None, "an entry of a vector must be a number, but this is a vector"),
}

_MADE_OF: Final = "an expression is made of numbers, positions, components a1.x or a1[0], vectors [1, 2], + - * / ** and functions"
_EACH: Final = "write each condition as a constraint of its own: all must hold anyway"
_KINDS: Final = {"v": "a vector such as a1 or [1, 2], but this is a number", "p": "a number such as a1.x, but this is a vector"}
_TOO_DEEP: Final = f"nested deeper than {MAX_DEPTH} levels; split it into several constraints"
_INSTEAD: Final[Mapping[str | type, str]] = {
    "abs": "abs has no gradient at 0; compare squares instead, e.g. 2**2 - p**2 for 2 - abs(p), or use sqrt(p**2 + 0.01)",
    "min": f"min has no gradient where its arguments meet; {_EACH}",
    "max": "max has no gradient where its arguments meet; write 1 - max(p, q) as two constraints, max(p, q) as log(exp(p) + exp(q))",
    "pow": "a power is written p ** 2",
    ast.Compare: "comparisons have no gradient; write psi so that psi > 0 is what you want: q - p for p < q, p - q for p > q, "
    "0.01 - (p - q)**2 for p == q",
    ast.And: f"'and' is not part of an expression; {_EACH}",
    ast.Or: "'or' is not part of an expression; log(exp(p) + exp(q)) > 0 is nearly 'p > 0 or q > 0'",
    ast.IfExp: f"'if' is not differentiable; {_EACH}",
    ast.Tuple: "a vector is written in square brackets, e.g. [1, 2]",
    ast.BitXor: "a power is written **, not ^",
}
"""Error messages for functions and syntax that users may expect but the language does not have."""


@dataclass(frozen=True)
class _Node:
    """One operation on the values of its operands.

    Attributes:
        operation: ``number``, ``agent``, ``time``, or a key of `_OPERATIONS`.
        operands: nodes of the operands.
        details: the exponent of ``**``, the axis of a component, the index of an agent in `Expression.reads`, or the value of a number.
            After `_lift`, a number has its index in `Expression.numbers` instead.
        column: column in the text, from 0; ignored by comparisons.
    """

    operation: str
    operands: tuple[_Node, ...] = ()
    details: tuple[Any, ...] = ()
    column: int = field(default=0, compare=False)


@dataclass(frozen=True)
class Formula:
    """ψ as a function of positions and numbers. Two formulas are equal if their trees have the same structure.

    The columns in its errors refer to the text of the expression it was made from.
    """

    tree: _Node

    def __call__(self, *positions: ArrayLike, numbers: ArrayLike, t: ArrayLike = 0.0) -> Array:
        """The value of ψ, a scalar.

        Args:
            positions: one (d,) array for each agent in `Expression.reads`, length.
            numbers: (K,) values of the literals, in the order of `Expression.numbers`.
            t: time, s.

        Raises:
            InvalidExpression: a number stands where a vector is required or vice versa, or a vector or component does not fit d.
        """
        value = _evaluate(self.tree, [jnp.asarray(x) for x in positions], jnp.asarray(numbers), jnp.asarray(t))
        if value.ndim:
            raise InvalidExpression(
                "psi must be a number, but this is a vector; did you mean norm2(...), or a component such as a1.x?", self.tree.column
            )
        return value


@dataclass(frozen=True)
class Expression:
    """A parsed text expression.

    Attributes:
        text: the text as written.
        reads: ids of the agents whose positions it takes, in order of first appearance.
        numbers: its literals after folding, in order of appearance. Exponents and axes are not among them: they are part of the structure.
        function: ψ as ``function(*positions, numbers=numbers)``, JAX-traceable. If `moves`, it also takes ``t=time``, s.
        moves: whether the expression reads the time.
    """

    text: str
    reads: tuple[str, ...]
    numbers: tuple[float, ...]
    function: Callable[..., Array]
    moves: bool = False

    @classmethod
    def parse(cls, text: str) -> Expression:
        """Parse `text`. The types of vectors and numbers are checked later, when `function` is called or traced.

        Raises:
            InvalidExpression: the text is not in the language. The message says what is wrong, where, and what would be right.
        """
        if not isinstance(text, str):
            raise InvalidExpression(f"an expression must be text, but this is of type {type(text).__name__}")
        if len(text) > MAX_LENGTH:
            raise InvalidExpression(f"an expression must have at most {MAX_LENGTH} characters, but this one has {len(text)}", MAX_LENGTH)
        line = re.sub(r"\s", " ", text)
        translator = _Translator(line)
        tree = translator.translate(_syntax(line))
        if not translator.reads:
            raise InvalidExpression("the expression reads no agent, so no one can change it; use the position of its owner, e.g. norm2(a1)")
        numbers: list[float] = []
        function = Formula(_lift(tree, numbers))
        return cls(text, tuple(translator.reads), tuple(numbers), function, translator.moves)


def _syntax(line: str) -> ast.expr:
    """Python's syntax tree of the line without its leading spaces. It may still contain syntax that the language does not have."""
    start = len(line) - len(line.lstrip())
    if start == len(line):
        raise InvalidExpression("the expression is empty; write e.g. 2**2 - norm2(a2 - a3)")
    unquoted = re.sub(r"'[^']*'|\"[^\"]*\"", lambda quoted: " " * len(quoted[0]), line)
    if "#" in unquoted:
        raise InvalidExpression("an expression has no comments; remove what follows #, or quote the id with it", unquoted.index("#"))
    if max(accumulate((char in "([{") - (char in ")]}") for char in unquoted)) > MAX_DEPTH:
        raise InvalidExpression(_TOO_DEEP, start)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "1if" and the like are refused anyway
            return ast.parse(line[start:], mode="eval").body
    except SyntaxError as error:
        column = min(start + max((error.offset or 1) - 1, 0), len(line))
        if error.msg.startswith("invalid syntax") and re.search("[^=!<>]=[^=]", unquoted):
            raise InvalidExpression(_INSTEAD[ast.Compare], column) from None
        right = "write e.g. 2**2 - norm2(a2 - a3), and in quotes an id that is no name: 'robot-1'"
        raise InvalidExpression(f"cannot be read as arithmetic ({error.msg.split('. ')[0]}); {right}", column) from None
    except ValueError:  # null bytes, lone surrogates
        raise InvalidExpression(f"there is a character that is no text; {_MADE_OF}") from None
    except (RecursionError, MemoryError):
        raise InvalidExpression(_TOO_DEEP, start) from None


class _Translator:
    """Translates Python's syntax tree to a tree of `_Node`s. Accepts only the syntax listed in `_ALLOWED`; folds literals."""

    def __init__(self, line: str) -> None:
        self.encoded = line.encode(errors="replace")  # the parser counts bytes
        self.start = len(line) - len(line.lstrip())
        self.reads: dict[str, int] = {}
        self.nodes = 0
        self.depth = 0
        self.moves = False

    def translate(self, node: ast.expr) -> _Node:
        """The node for a piece of Python syntax, by the method that `_ALLOWED` names. Checks the limits on depth and size."""
        self.nodes += 1
        self.depth += 1
        if self.depth > MAX_DEPTH:
            self.fault(node, _TOO_DEEP)
        if self.nodes > MAX_NODES:
            self.fault(node, f"more than {MAX_NODES} numbers, positions and operations; split it into several constraints")
        kind = type(getattr(node, "op", node))  # of an operation, the operator
        if kind not in _ALLOWED:
            self.fault(node, _INSTEAD.get(kind, f"{_MADE_OF}; Python's {kind.__name__} is not among them"))
        translated = _ALLOWED[kind](self, node)
        self.depth -= 1
        return translated

    def constant(self, node: ast.Constant) -> _Node:
        value = node.value
        if isinstance(value, int | float) and not isinstance(value, bool):
            return _number(value, self.column(node))
        if not isinstance(value, str):
            self.fault(node, f"{reprlib.repr(value)} is not a real number; {_MADE_OF}")
        if not value or "\\" in value or self.segment(node)[1:-1] != value:
            self.fault(node, "text in quotes is an agent id, written plainly: 'robot-1'")
        return self.agent(node, value)

    def name(self, node: ast.Name) -> _Node:
        name = self.segment(node)  # not node.id: Python normalises its letters, which could merge two agent ids
        if name in _FUNCTIONS:
            self.fault(node, f"{_usage(name)} is a function; an agent with this id is written '{name}'")
        if name == "t":
            self.moves = True
            return _Node("time", column=self.column(node))
        return _number(math.pi, self.column(node)) if name == "pi" else self.agent(node, name)

    def agent(self, node: ast.expr, name: str) -> _Node:
        return _Node("agent", (), (self.reads.setdefault(name, len(self.reads)),), self.column(node))

    def sign(self, node: ast.UnaryOp) -> _Node:
        operand = self.translate(node.operand)
        return operand if isinstance(node.op, ast.UAdd) else _apply("-", self.column(node), operand)

    def sum(self, node: ast.BinOp) -> _Node:
        """Translates ``p + q - r + …`` to one operation on many terms, so that a long sum is not a deep tree."""
        chain = [node]
        while isinstance(chain[-1].left, ast.BinOp) and isinstance(chain[-1].left.op, ast.Add | ast.Sub):
            chain.append(chain[-1].left)
        self.nodes += len(chain) - 1
        total = self.translate(chain[-1].left)
        for link in reversed(chain):
            term = self.translate(link.right)
            if isinstance(link.op, ast.Sub):
                term = _apply("-", term.column, term)
            terms = total.operands if total.operation == "+" else (total,)
            total = _apply("+", total.column, *terms, term)
        return total

    def scale(self, node: ast.BinOp) -> _Node:
        left, right = self.translate(node.left), self.translate(node.right)
        if isinstance(node.op, ast.Div) and right.operation == "number" and right.details[0] == 0:
            raise InvalidExpression("division by zero", right.column)
        return _apply("*" if isinstance(node.op, ast.Mult) else "/", self.column(node), left, right)

    def power(self, node: ast.BinOp) -> _Node:
        base, exponent = self.translate(node.left), self.translate(node.right)
        if exponent.operation != "number":
            raise InvalidExpression("an exponent must be a literal number; for p ** q with p > 0 write exp(q * log(p))", exponent.column)
        power: float = exponent.details[0]
        if abs(power) > MAX_EXPONENT:
            raise InvalidExpression(f"an exponent must be from -{MAX_EXPONENT} to {MAX_EXPONENT}, but this is {power:g}", exponent.column)
        return _apply("**", self.column(node), base, details=(int(power) if power.is_integer() else power,))

    def component(self, node: ast.Attribute | ast.Subscript) -> _Node:
        match node:
            case ast.Attribute(attr="x" | "y" | "z" as letter):
                axis = "xyz".index(letter)
            case ast.Subscript(slice=ast.Constant(value=int() as axis)) if axis is not True and axis is not False and axis <= MAX_NUMBER:
                pass
            case _:
                self.fault(node, "a component is written a1.x, a1.y, a1.z or, counted from 0, a1[0]; an id with a dot is quoted: 'team.a1'")
        return _Node("component", (self.translate(node.value),), (axis,), self.column(node))

    def vector(self, node: ast.List) -> _Node:
        if not node.elts:
            self.fault(node, "a vector has entries, e.g. [1, 2]")
        return _Node("vector", tuple(self.translate(entry) for entry in node.elts), column=self.column(node))

    def call(self, node: ast.Call) -> _Node:
        usages = ", ".join(map(_usage, _FUNCTIONS))
        if not isinstance(node.func, ast.Name):
            self.fault(node, f"only functions can be called; the functions are {usages}")
        name = self.segment(node.func)
        if name not in _FUNCTIONS:
            close = difflib.get_close_matches(name[:30], _FUNCTIONS, 1)
            meant = f"did you mean {close[0]}? " if close else ""
            self.fault(node, _INSTEAD.get(name, f"unknown function {reprlib.repr(name)}; {meant}the functions are {usages}"))
        if node.keywords or len(node.args) != len(_FUNCTIONS[name].takes):
            given = "is a named one" if node.keywords else f"are {len(node.args)}"
            self.fault(node, f"the arguments must be as in {_usage(name)}, but here {given}")
        return _apply(name, self.column(node), *(self.translate(argument) for argument in node.args))

    def fault(self, node: ast.expr, message: str) -> NoReturn:
        """Raises: InvalidExpression: always, with the column of `node`."""
        raise InvalidExpression(message, self.column(node))

    def column(self, node: ast.expr) -> int:
        """The column in the text, in characters from 0."""
        return len(self.encoded[: self.start + node.col_offset].decode())

    def segment(self, node: ast.expr) -> str:
        """The text of a piece of syntax, unchanged."""
        return self.encoded[self.start + node.col_offset : self.start + (node.end_col_offset or 0)].decode()


_ALLOWED: Final[Mapping[type, Callable[[_Translator, Any], _Node]]] = {
    ast.Constant: _Translator.constant,
    ast.Name: _Translator.name,
    ast.UAdd: _Translator.sign,
    ast.USub: _Translator.sign,
    ast.Add: _Translator.sum,
    ast.Sub: _Translator.sum,
    ast.Mult: _Translator.scale,
    ast.Div: _Translator.scale,
    ast.Pow: _Translator.power,
    ast.Attribute: _Translator.component,
    ast.Subscript: _Translator.component,
    ast.List: _Translator.vector,
    ast.Call: _Translator.call,
}


def _usage(name: str) -> str:
    return f"{name}({', '.join(_FUNCTIONS[name].takes)})"


def _number(value: float, column: int) -> _Node:
    if not abs(value) <= MAX_NUMBER:
        raise InvalidExpression(f"numbers must be finite and at most {MAX_NUMBER:g} in size; choose a larger unit", column)
    return _Node("number", (), (float(value) + 0.0,), column)  # + 0.0: there is no -0


def _apply(operation: str, column: int, *operands: _Node, details: tuple[float, ...] = ()) -> _Node:
    """The node of an operation, or of its value if all its operands are literals."""
    fold = _OPERATIONS[operation].fold
    if fold is None or any(operand.operation != "number" for operand in operands):
        return _Node(operation, operands, details, column)
    try:
        value = fold(*(operand.details[0] for operand in operands), *details)
    except (OverflowError, ValueError):
        raise InvalidExpression(f"{operation} has no finite real value at {operands[0].details[0]:g}", column) from None
    return _number(value, column)


def _lift(node: _Node, numbers: list[float]) -> _Node:
    """The tree with each literal replaced by its index in `numbers`. Appends the literals to `numbers`."""
    if node.operation == "number":
        numbers.append(node.details[0])
        return replace(node, details=(len(numbers) - 1,))
    return replace(node, operands=tuple(_lift(operand, numbers) for operand in node.operands))


def _evaluate(node: _Node, positions: Sequence[Array], numbers: Array, t: Array) -> Array:
    if node.operation == "number":
        return numbers[node.details[0]]
    if node.operation == "agent":
        return positions[node.details[0]]
    if node.operation == "time":
        return t
    values = [_evaluate(operand, positions, numbers, t) for operand in node.operands]
    kinds = "".join("v" if value.ndim else "p" for value in values)
    operation = _OPERATIONS[node.operation]
    if not re.fullmatch(operation.takes, kinds):
        wanted = operation.takes.strip(".")[0]
        odd = next(operand for operand, kind in zip(node.operands, kinds, strict=True) if kind != wanted)
        raise InvalidExpression(operation.wrong or f"{_usage(node.operation)} takes {_KINDS[wanted]}", odd.column)
    if node.operation == "vector" and len(values) != positions[0].size:
        raise InvalidExpression(
            f"a vector has {counted(positions[0].size, 'entry', 'entries')} here, one a dimension, but this has {len(values)}", node.column
        )
    if node.operation == "component" and node.details[0] >= values[0].size:
        raise InvalidExpression(f"in dimension {values[0].size}, component {node.details[0]}, counted from 0, does not exist", node.column)
    return operation.apply(*values, *node.details)
