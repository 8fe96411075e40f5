"""Conditions on an episode's metrics: `success and tracking_p95 < 0.1 and not fall`.

The syntax is a subset of Python's: `and or not`, `< <= > >= == !=`, `in`, `is None`, `+ - * / %`,
`abs min max`, numbers, texts, lists of them, `True False`. Names and types are checked before any
episode is read; evaluation is from left to right.

A metric may be missing (None) where the dataset lacks its columns. A condition that reaches a
missing metric has no result, and its episode is excluded; `x is None` tests for it.
"""

from __future__ import annotations

import ast
import difflib
import re
import warnings
from collections.abc import Mapping
from enum import Enum
from typing import Any, NoReturn

from xop_lerobot.core.errors import BadValue, UnknownName

MAX_LENGTH = 2000
"""Largest length of an expression [characters]."""


class Kind(Enum):
    """Type of a metric; the value is how errors call it."""

    FLAG = "yes or no"
    NUMBER = "a number"
    TEXT = "a text"


class UnknownFigure(UnknownName):
    """An expression contains an unknown name; the message lists the known ones."""

    def __init__(self, name: str, known: Mapping[str, Kind]) -> None:
        super().__init__("metric", name, known)
        near = difflib.get_close_matches(name, [*known, "True", "False", "None"], 1)
        if near:
            head, tail = self.args[0].split(". Known", 1)
            self.args = (f"{head}. Did you mean {near[0]!r}? Known{tail}",)


class _Missing(Exception):
    """Raised when the expression reaches a missing metric."""


class _Figures(dict[str, Any]):
    """Values by name as Python looks them up: `x` raises if missing, `x?` returns None."""

    def __getitem__(self, name: str) -> Any:
        if name.endswith(_MAY_BE_MISSING):
            return super().__getitem__(name.removesuffix(_MAY_BE_MISSING))
        if super().__getitem__(name) is None:
            raise _Missing(name)
        return super().__getitem__(name)


_MAY_BE_MISSING = "?"
_KINDS: Mapping[type, Kind] = {
    bool: Kind.FLAG, int: Kind.NUMBER, float: Kind.NUMBER, str: Kind.TEXT,
}  # fmt: skip
_FUNCTIONS: Mapping[str, Any] = {"abs": abs, "min": min, "max": max}
_GLOBALS = {"__builtins__": _FUNCTIONS}


class Expression:
    """Condition on an episode.

    Args:
        text: The expression, stripped.
        kinds: Type of each name that may occur.

    Attributes:
        text: The same.
        names: The names that occur.

    Raises:
        UnknownFigure: If it contains another name.
        BadValue: If it is malformed or not boolean; the message quotes the fault.
    """

    def __init__(self, text: str, kinds: Mapping[str, Kind]) -> None:
        self.text = text.strip()
        self.names: frozenset[str] = frozenset()
        self._kinds = kinds
        if len(self.text) > MAX_LENGTH:
            raise BadValue(f"an expression has at most {MAX_LENGTH} characters, got {len(text)}")
        try:
            with warnings.catch_warnings(action="ignore"):  # Python's warnings about odd code
                tree = ast.parse(self.text, mode="eval")
                kind = self._check(tree.body)
                if kind is not Kind.FLAG:
                    self._refuse(tree.body, f"is {kind.value}, and must be yes or no. Compare it")
                self._code = compile(tree, "<expression>", "eval")
        except SyntaxError as error:
            self._refuse_syntax(error)
        except (RecursionError, MemoryError, ValueError) as error:
            raise BadValue(f"expression '{self.text[:40]}…' is too deep, or malformed") from error

    def evaluate(self, values: Mapping[str, Any]) -> bool | None:
        """Evaluate the expression on one episode, from left to right as Python does.

        Args:
            values: Value of each name in `names`; None if missing.

        Returns:
            Whether it holds; None if it reaches a missing metric, or divides by zero.
        """
        try:
            return eval(
                self._code, _GLOBALS, _Figures(values)
            )  # safe: `_check` has admitted a fixed set of nodes
        except (_Missing, ArithmeticError):
            return None

    def _check(self, node: ast.expr) -> Kind:
        """Check that a node is one of the permitted kinds; return its type."""
        match node:
            case ast.Constant(value=bool() | int() | float() | str() as value):
                return _KINDS[type(value)]
            case ast.Name(id=name):
                if name not in self._kinds:
                    raise UnknownFigure(name, self._kinds)
                self.names |= {name}
                return self._kinds[name]
            case ast.Compare():
                return self._check_comparison(node)
            case ast.BoolOp(values=parts):
                return self._expect(Kind.FLAG, parts)
            case ast.UnaryOp(op=ast.Not(), operand=part):
                return self._expect(Kind.FLAG, [part])
            case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=part):
                parts = [part]
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div() | ast.Mod(),
                           right=right):  # fmt: skip
                parts = [left, right]
            case ast.Call():
                parts = self._check_call(node)
            case _:
                self._refuse(
                    node,
                    "cannot be written here. Known: and, or, not (as words), <, <=, >, >=, ==, "
                    "!=, in (and a list after it), is None, +, -, *, /, %, abs, min, max, "
                    "numbers and texts",
                )
        return self._expect(Kind.NUMBER, parts)

    def _check_call(self, node: ast.Call) -> list[ast.expr]:
        name, count = ast.unparse(node.func), len(node.args)
        if name not in _FUNCTIONS:
            raise UnknownName("function in an expression", name, _FUNCTIONS)
        if node.keywords or count < 1 or (name == "abs") != (count == 1):
            self._refuse(node, f"has {count} arguments. Write abs(x), min(x, y) or max(x, y)")
        return node.args

    def _check_comparison(self, node: ast.Compare) -> Kind:
        kind, right = self._check(node.left), node.comparators[0]
        match node.ops:
            case [ast.Is() | ast.IsNot()]:
                is_none = isinstance(right, ast.Constant) and right.value is None
                if not is_none or not isinstance(node.left, ast.Name):
                    self._refuse(node, "has `is`, which asks a metric for None alone")
                node.left.id += _MAY_BE_MISSING
            case [ast.In() | ast.NotIn()] if isinstance(right, ast.Tuple | ast.List | ast.Set):
                self._expect(kind, right.elts)
            case [ast.In() | ast.NotIn()]:
                if kind is not Kind.TEXT:
                    self._refuse(node, "must have a list after `in`, such as (1, 2)")
                self._expect(kind, [right])
            case signs:
                for sign, part in zip(signs, node.comparators, strict=True):
                    self._check_link(node, kind, sign, part)
        return Kind.FLAG

    def _check_link(self, node: ast.Compare, kind: Kind, sign: ast.cmpop, right: ast.expr) -> None:
        """Check the right side of a comparison, given the type of the left side."""
        if isinstance(right, ast.Constant) and right.value is None:
            self._refuse(node, "compares with None. Write `is None` or `is not None`")
        other = self._check(right)
        if kind is not other:
            self._refuse(
                node,
                f"compares two kinds: '{self._quote(node.left)}' is {kind.value}, "
                f"'{self._quote(right)}' is {other.value}",
            )
        if not isinstance(sign, ast.Eq | ast.NotEq) and kind is not Kind.NUMBER:
            self._refuse(node, "orders values that are not numbers. Known: ==, !=")
        if isinstance(sign, ast.Is | ast.IsNot | ast.In | ast.NotIn):
            self._refuse(node, "has `in` or `is` in a chain. Write each comparison alone")

    def _expect(self, expected: Kind, parts: list[ast.expr]) -> Kind:
        for part in parts:
            kind = self._check(part)
            if kind is not expected:
                self._refuse(part, f"is {kind.value}, and must be {expected.value} there")
        return expected

    def _quote(self, node: ast.expr) -> str:
        return ast.get_source_segment(self.text, node) or ast.unparse(node)

    def _refuse(self, node: ast.expr, fault: str) -> NoReturn:
        raise BadValue(f"expression '{self.text}': '{self._quote(node)}' {fault}")

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
