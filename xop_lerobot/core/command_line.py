"""Shared parts of this project's commands: argument parser, error reports, readable output, tables.

In LeRobot's commands, an error of this project is reported in one line. LeRobot itself prints a
traceback for every error and wraps those of a device's constructor in the whole configuration, so
that the cause is at the end of some forty lines. `XOP_TRACEBACK=1` restores the traceback.
"""

from __future__ import annotations

import argparse
import codecs
import io
import os
import re
import sys
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from xop_lerobot.core.errors import BadValue, UnknownName, XopError

_SPELL_OUT = "xop-spell-out"
_SPELLINGS = {
    "…": "...", "–": "-", "—": "-", "−": "-", "→": "->", "×": "x", "·": ".", "±": "+/-",
    "≤": "<=", "≥": ">=", "°": "deg", "‘": "'", "’": "'", "“": '"', "”": '"', "⚠": "!",
}  # fmt: skip
"""ASCII spellings of characters that Unicode decomposition does not reduce to ASCII."""


def make_output_readable() -> None:
    r"""Make output readable, and never an error, in terminals with a limited encoding.

    Symbols are spelt out, letters lose their accents, and other characters are escaped as in
    Python: `1/s²`, `…`, `é` and `手` become `1/s2`, `...`, `e` and `\u624b` in ASCII. This also
    holds for pipes; UTF-8 streams are unchanged, except for undecodable parts of paths. Every
    command calls this first.
    """
    codecs.register_error(_SPELL_OUT, _spell_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not an object that has replaced it
            stream.reconfigure(errors=_SPELL_OUT)


def can_print_anything() -> bool:
    """Whether standard output is encoded in UTF-8 or another UTF."""
    encoding = getattr(sys.stdout, "encoding", None) or ""
    return encoding.lower().replace("-", "").startswith("utf")


def _spell_out(error: UnicodeError) -> tuple[str, int]:
    """Error handler for `codecs` that spells out characters which an encoding lacks."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    piece = error.object[error.start : error.end]
    return "".join(map(_spell, piece)), error.end


def _spell(character: str) -> str:
    if character in _SPELLINGS:
        return _SPELLINGS[character]
    plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode("ascii")
    return plain or character.encode("ascii", "backslashreplace").decode("ascii")


class CommandParser(argparse.ArgumentParser):
    """An argument parser that raises instead of exiting, and accepts no abbreviated flags.

    Args:
        prog: Name of the command in messages.
        description: Description of the command; line breaks are kept.
        options: Any other argument of `argparse.ArgumentParser`.
    """

    def __init__(self, prog: str, description: str | None = None, **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(prog=prog, description=description, allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise `BadValue` for a malformed command line."""
        raise BadValue(message)

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Parse the command line.

        Raises:
            BadValue: If a flag is missing or malformed.
            UnknownName: If a flag is unknown; lists the known ones.
        """
        flags = [flag for action in self._actions for flag in action.option_strings]
        known = [flag for flag in flags if flag.startswith("--")]

        def refuse(word: str) -> NoReturn:
            raise UnknownName(f"flag of {self.prog}", word, known)

        # Check for unknown flags first: a misspelt flag must not be reported as a missing one.
        for word in arguments:
            if word.startswith("--") and word.partition("=")[0] not in known:
                refuse(word)
        parsed, unknown = self.parse_known_args(arguments)
        if unknown:
            refuse(unknown[0])
        return parsed


INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM, by the convention of shells (128 + SIGINT)."""
TRACEBACK_VARIABLE = "XOP_TRACEBACK"
_COMMANDS = ("lerobot-", "lerobot_")


def find_mistake(error: BaseException | None) -> XopError | None:
    """Return the outermost error of this project in the chain of explicit causes of `error`."""
    while error is not None and not isinstance(error, XopError):
        error = error.__cause__
    return error


def report_mistakes() -> None:
    """Report this project's errors in one line if one of LeRobot's commands is running.

    Other programs, and all other errors, keep their tracebacks.
    """
    program = Path(sys.argv[0]).name if sys.argv else ""
    stock = sys.excepthook
    if not program.startswith(_COMMANDS) or getattr(stock, "xop_stock", None):
        return
    make_output_readable()

    def report(
        kind: type[BaseException], error: BaseException, trace: TracebackType | None
    ) -> None:
        mistake = find_mistake(error)
        if mistake is None or os.environ.get(TRACEBACK_VARIABLE):
            stock(kind, error, trace)
        else:
            print(f"error: {mistake}", file=sys.stderr)

    report.xop_stock = stock  # pyright: ignore[reportFunctionMemberAccess]
    sys.excepthook = report


def split_pair(text: str, form: str) -> tuple[str, str]:
    """Split `NAME=VALUE`, stripped of blanks.

    Args:
        text: The text to split.
        form: Expected form, with which the message begins: `--part takes NAME=SHARE`.

    Raises:
        BadValue: If name or value is missing.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    if not (name and value):
        raise BadValue(f"{form}, got '{text}'")
    return name, value


def say_count(count: int, noun: str) -> str:
    """Format a count with its noun: 1 episode, 2 episodes.

    Args:
        count: The count.
        noun: A regular noun in the singular.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


_NUMBER = re.compile(r"[-+]?\.?\d[-+±/.,:%\d\se]*$|-?$")
"""Numeric cells of a table, such as 3/20 or 1.5 ± 0.2; a dash or an empty cell is a missing one."""


def format_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table for a terminal: heads, a rule and one line per row.

    Columns of numbers are aligned right, others left.

    Args:
        heads: Head of each column.
        rows: Cells of each row, one per head.
    """
    columns = list(zip(heads, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [any(column[1:]) and all(map(_NUMBER.match, column[1:])) for column in columns]
    rule = ["-" * width for width in widths]
    return "\n".join(align_cells(line, widths, right) for line in (heads, rule, *rows))


def align_cells(cells: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    """Align the cells of a row in columns of given widths, two spaces apart.

    Args:
        cells: Texts; those that are too long are truncated with an ellipsis.
        widths: Width of each column [characters].
        right: Whether each column is aligned right.
    """
    parts = []
    for cell, width, is_right in zip(cells, widths, right, strict=True):
        text = f"{cell[: width - 1]}…" if len(cell) > width else cell
        parts.append(text.rjust(width) if is_right else text.ljust(width))
    return "  ".join(parts).rstrip()
