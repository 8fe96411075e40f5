"""Small expressions over an episode's figures: `success and tracking_p95 < 0.1 and not fall`.

They look like Python and are checked as a whole, names and kinds included, before any episode is
read. Nothing but what is listed here can be written: `and or not`, `< <= > >= == !=`, `in`,
`is None`, `+ - * / %`, `abs min max`, numbers, texts, lists of them, `True False None`.

A figure may be unknown (None): the dataset has not the columns for it. Then so is whatever is
computed or compared with it, and `not`; but `False and x` is false and `True or x` is true
whatever x is. `x is None` asks whether it is unknown.
"""

from __future__ import annotations

import ast
import difflib
import math
import operator
import re
import warnings
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NoReturn

from xop_lerobot.core.errors import BadValue, UnknownName

MAX_LENGTH = 2000
"""Characters that an expression may have."""


class Kind(Enum):
    """What a figure is, as it reads in an error."""

    FLAG = "yes or no"
    NUMBER = "a number"
    TEXT = "a text"
    LIST = "a list"
    NONE = "None"


class UnknownFigure(UnknownName):
    """An expression has a name that is no figure; the message lists those that are."""

    def __init__(self, name: str, known: Mapping[str, Kind]) -> None:
        super().__init__("figure", name, known)
        near = difflib.get_close_matches(name, [*known, "True", "False", "None"], 1)
        if near:
            head, tail = self.args[0].split(". Known", 1)
            self.args = (f"{head}. Did you mean {near[0]!r}? Known{tail}",)


type _Values = Mapping[str, Any]
type _Code = Callable[[_Values], Any]

_COMPARISONS: Mapping[type[ast.cmpop], tuple[str, Callable[[Any, Any], bool]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
_ARITHMETIC: Mapping[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", operator.add),
    ast.Sub: ("-", operator.sub),
    ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv),
    ast.Mod: ("%", operator.mod),
}
_COMPILERS: Mapping[type[ast.expr], str] = {
    ast.Constant: "_compile_constant",
    ast.Name: "_compile_name",
    ast.BoolOp: "_compile_logic",
    ast.UnaryOp: "_compile_sign",
    ast.BinOp: "_compile_arithmetic",
    ast.Compare: "_compile_comparison",
    ast.Call: "_compile_call",
}
"""What may be written, and which method compiles it."""
_FUNCTIONS: Mapping[str, Callable[..., Any]] = {"abs": abs, "min": min, "max": max}


class Expression:
    """A condition on an episode.

    Args:
        text: The expression.
        kinds: Every name that may be in it, and what it is.

    Attributes:
        text: The same.
        names: The names that are in it.

    Raises:
        UnknownFigure: If it has another name.
        BadValue: If it is malformed, or is not yes or no; the message quotes the fault.
    """

    def __init__(self, text: str, kinds: Mapping[str, Kind]) -> None:
        self.text = text.strip()
        self.names: frozenset[str] = frozenset()
        self._kinds = kinds
        if len(self.text) > MAX_LENGTH:
            raise BadValue(f"an expression has at most {MAX_LENGTH} characters, got {len(text)}")
        try:
            with warnings.catch_warnings(action="ignore"):  # Python's own on what is odd
                tree = ast.parse(self.text, mode="eval")
            kind, self._code = self._compile(tree.body)
        except SyntaxError as error:
            self._refuse_syntax(error)
        except (RecursionError, MemoryError, ValueError) as error:
            if isinstance(error, BadValue):
                raise
            raise BadValue(f"expression '{self.text[:40]}…' is too deep, or malformed") from error
        if kind is not Kind.FLAG:
            self._refuse(tree.body, f"is {kind.value}, and must be yes or no. Compare it")

    def evaluate(self, values: Mapping[str, Any]) -> bool | None:
        """Evaluate the expression on one episode.

        Args:
            values: Value of each name in `names`; None for what is not known.

        Returns:
            Whether it holds; None if that is not known.
        """
        return self._code(values)

    # Each of these returns what a part is and how it is computed.

    def _compile(self, node: ast.expr) -> tuple[Kind, _Code]:
        if isinstance(node, ast.Tuple | ast.List | ast.Set):
            self._refuse(node, "is a list, which stands only after `in`")
        name = _COMPILERS.get(type(node))
        if name is None:
            self._refuse(
                node,
                "cannot be written here. Known: and, or, not, <, <=, >, >=, ==, !=, in, "
                "is None, +, -, *, /, %, abs, min, max, numbers and texts",
            )
        return getattr(self, name)(node)

    def _compile_constant(self, node: ast.Constant) -> tuple[Kind, _Code]:
        value = node.value
        if value is None:
            return Kind.NONE, lambda values: None
        if isinstance(value, bool):
            return Kind.FLAG, lambda values: value
        if isinstance(value, int | float):
            return Kind.NUMBER, lambda values: value
        if isinstance(value, str):
            return Kind.TEXT, lambda values: value
        self._refuse(node, "is no number and no text")

    def _compile_name(self, node: ast.Name) -> tuple[Kind, _Code]:
        name = node.id
        if name not in self._kinds:
            raise UnknownFigure(name, self._kinds)
        self.names |= {name}
        return self._kinds[name], lambda values: values[name]

    def _compile_logic(self, node: ast.BoolOp) -> tuple[Kind, _Code]:
        parts = [self._expect(part, Kind.FLAG) for part in node.values]
        decisive = isinstance(node.op, ast.Or)

        def decide(values: _Values) -> bool | None:
            results = [part(values) for part in parts]
            if decisive in results:
                return decisive
            return None if None in results else not decisive

        return Kind.FLAG, decide

    def _compile_sign(self, node: ast.UnaryOp) -> tuple[Kind, _Code]:
        if isinstance(node.op, ast.Not):
            return Kind.FLAG, _lift(operator.not_, self._expect(node.operand, Kind.FLAG))
        if isinstance(node.op, ast.USub | ast.UAdd):
            sign = operator.neg if isinstance(node.op, ast.USub) else operator.pos
            return Kind.NUMBER, _lift(sign, self._expect(node.operand, Kind.NUMBER))
        self._refuse(node, "has an operator that is not known. Known: not, -")

    def _compile_arithmetic(self, node: ast.BinOp) -> tuple[Kind, _Code]:
        if type(node.op) not in _ARITHMETIC:
            hint = " (for 'and' and 'or', write the words)"
            known = ", ".join(sign for sign, _ in _ARITHMETIC.values())
            self._refuse(node, f"has an operator that is not known. Known: {known}{hint}")
        _, function = _ARITHMETIC[type(node.op)]
        sides = [self._expect(side, Kind.NUMBER) for side in (node.left, node.right)]
        return Kind.NUMBER, _lift(function, *sides)

    def _compile_call(self, node: ast.Call) -> tuple[Kind, _Code]:
        name = node.func.id if isinstance(node.func, ast.Name) else ast.unparse(node.func)
        if name not in _FUNCTIONS:
            raise UnknownName("function in an expression", name, _FUNCTIONS)
        count = len(node.args)
        if node.keywords or count < 1 or (name == "abs") != (count == 1):
            self._refuse(node, f"has {count} arguments. Write abs(x), min(x, y) or max(x, y)")
        arguments = [self._expect(argument, Kind.NUMBER) for argument in node.args]
        return Kind.NUMBER, _lift(_FUNCTIONS[name], *arguments)

    def _compile_comparison(self, node: ast.Compare) -> tuple[Kind, _Code]:
        links = []
        left = node.left
        for sign, right in zip(node.ops, node.comparators, strict=True):
            links.append(self._compile_link(node, left, sign, right))
            left = right

        def chain(values: _Values) -> bool | None:
            results = [link(values) for link in links]
            return False if False in results else None if None in results else True

        return Kind.FLAG, chain

    def _compile_link(
        self, node: ast.Compare, left: ast.expr, sign: ast.cmpop, right: ast.expr
    ) -> _Code:
        if isinstance(sign, ast.Is | ast.IsNot):
            if not (isinstance(right, ast.Constant) and right.value is None):
                self._refuse(node, "has `is`, which asks for None alone. Write == to compare")
            _, code = self._compile(left)
            wanted = isinstance(sign, ast.Is)
            return lambda values: (code(values) is None) == wanted
        if isinstance(sign, ast.In | ast.NotIn):
            return self._compile_membership(node, left, sign, right)
        (first, code), (second, other) = self._compile(left), self._compile(right)
        text, function = _COMPARISONS[type(sign)]
        if Kind.NONE in (first, second):
            self._refuse(node, "compares with None. Write `is None` or `is not None`")
        if first is not second:
            self._refuse(
                node,
                f"compares two kinds: '{ast.unparse(left)}' is {first.value}, "
                f"'{ast.unparse(right)}' is {second.value}",
            )
        if first is not Kind.NUMBER and not isinstance(sign, ast.Eq | ast.NotEq):
            self._refuse(node, f"orders by {text} what is no number. Known: ==, !=")
        return _lift(function, code, other)

    def _compile_membership(
        self, node: ast.Compare, left: ast.expr, sign: ast.cmpop, right: ast.expr
    ) -> _Code:
        kind, code = self._compile(left)
        if isinstance(right, ast.Tuple | ast.List | ast.Set):
            others = [self._expect(item, kind) for item in right.elts]
        elif kind is Kind.TEXT:
            whole = self._expect(right, Kind.TEXT)
            found = _lift(lambda part, text: part in text, code, whole)
            return found if isinstance(sign, ast.In) else _lift(operator.not_, found)
        else:
            self._refuse(node, "must have a list after `in`, such as (1, 2)")

        def look(values: _Values) -> bool | None:
            value, items = code(values), [other(values) for other in others]
            if value is None:
                return None
            return True if value in items else None if None in items else False

        return look if isinstance(sign, ast.In) else _lift(operator.not_, look)

    def _expect(self, node: ast.expr, expected: Kind) -> _Code:
        kind, code = self._compile(node)
        if kind is not expected:
            self._refuse(node, f"is {kind.value}, and must be {expected.value} there")
        return code

    def _refuse(self, node: ast.expr, fault: str) -> NoReturn:
        part = ast.unparse(node)
        raise BadValue(f"expression '{self.text}': '{part}' {fault}")

    def _refuse_syntax(self, error: SyntaxError) -> NoReturn:
        place = f" at character {error.offset}" if error.offset else ""
        hint = ""
        if "&&" in self.text or "||" in self.text or "!" in self.text.replace("!=", ""):
            hint = ". Write and, or, not"
        elif re.search("(?<![=<>!])=(?!=)", self.text):
            hint = ". To compare, write =="
        raise BadValue(
            f"expression '{self.text}' is malformed{place}: {error.msg}{hint}"
        ) from error


def _lift(function: Callable[..., Any], *parts: _Code) -> _Code:
    """Make `function` of the parts' values; unknown if one is, or if it has no finite value."""

    def compute(values: _Values) -> Any:
        arguments = [part(values) for part in parts]
        if any(argument is None for argument in arguments):
            return None
        try:
            result = function(*arguments)
        except ArithmeticError:
            return None
        return None if isinstance(result, float) and not math.isfinite(result) else result

    return compute
