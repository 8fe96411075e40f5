"""What the commands of this project share: a parser with its errors, readable output, tables.

A user's mistake ends LeRobot's commands in one line that names it. LeRobot lets every error end in
a traceback and wraps those of a device's constructor in its whole configuration, so that what is
wrong stands at the end of some forty lines. `XOP_TRACEBACK=1` brings the traceback back.
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
"""What is not just a letter with an accent, or a digit in another place."""


def make_output_readable() -> None:
    r"""Let what is printed be read in terminals that cannot show all of it, and never be an error.

    Signs are spelt out, letters lose their accents, and anything else becomes its number, as in
    Python: `1/s²`, `…`, `é` and `手` are `1/s2`, `...`, `e` and `\u624b` in ASCII. Streams that
    are no terminal, such as pipes, are treated alike; those in UTF-8 stay as they are, but for
    parts of paths that are no text at all. Each command calls it first.
    """
    codecs.register_error(_SPELL_OUT, _spell_out)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # and nothing that somebody has put in its place
            stream.reconfigure(errors=_SPELL_OUT)


def can_print_anything() -> bool:
    """Whether standard output can show any text as it is."""
    encoding = getattr(sys.stdout, "encoding", None) or ""
    return encoding.lower().replace("-", "").startswith("utf")


def _spell_out(error: UnicodeError) -> tuple[str, int]:
    """Replace what an encoding does not have, as an error handler of `codecs` does."""
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
    """A parser that raises instead of ending the process, and takes no abbreviated flags.

    Args:
        prog: Name of the command, as it reads in an error.
        description: What the command does; kept line by line.
        options: Any other argument of `argparse.ArgumentParser`.
    """

    def __init__(self, prog: str, description: str | None = None, **options: Any) -> None:
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(prog=prog, description=description, allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise the error of a malformed command line."""
        raise BadValue(message)

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Read the command line.

        Raises:
            BadValue: If a flag is absent or malformed.
            UnknownName: If one is unknown, listing the known ones.
        """
        flags = [flag for action in self._actions for flag in action.option_strings]
        known = [flag for flag in flags if flag.startswith("--")]

        def refuse(word: str) -> NoReturn:
            raise UnknownName(f"flag of {self.prog}", word, known)

        # A misspelt flag is what is wrong, and not that the right one is absent.
        for word in arguments:
            if word.startswith("--") and word.partition("=")[0] not in known:
                refuse(word)
        parsed, unknown = self.parse_known_args(arguments)
        if unknown:
            refuse(unknown[0])
        return parsed


INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM, as shells have it."""
TRACEBACK_VARIABLE = "XOP_TRACEBACK"
_COMMANDS = ("lerobot-", "lerobot_")


def find_mistake(error: BaseException | None) -> XopError | None:
    """Return the outermost error of this project among `error` and its explicit causes."""
    while error is not None and not isinstance(error, XopError):
        error = error.__cause__
    return error


def report_mistakes() -> None:
    """Let this project's errors end the process in one line, if one of LeRobot's commands runs.

    Programs of others keep their tracebacks, and so do all other errors.
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
    """Split `NAME=VALUE`, both without blanks around them.

    Args:
        text: What was given.
        form: What must be given, as a message begins: `--part takes NAME=SHARE`.

    Raises:
        BadValue: If either is missing.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    if not (name and value):
        raise BadValue(f"{form}, got '{text}'")
    return name, value


def say_count(count: int, noun: str) -> str:
    """Return a number of things in words: 1 episode, 2 episodes.

    Args:
        count: How many.
        noun: What, in the singular; a regular one.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


_NUMBER = re.compile(r"[-+]?\.?\d[-+±/.,:%\d\se]*$|-?$")
"""Numbers in a table, such as 3/20 or 1.5 ± 0.2; a dash or nothing stands for a missing one."""


def format_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table for a terminal: heads, a rule and a line for each row.

    A column whose cells are all numbers is aligned right, any other one left.

    Args:
        heads: Head of each column.
        rows: Cells of each row, as many as there are heads.
    """
    columns = list(zip(heads, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [any(column[1:]) and all(map(_NUMBER.match, column[1:])) for column in columns]
    rule = ["-" * width for width in widths]
    return "\n".join(align_cells(line, widths, right) for line in (heads, rule, *rows))


def align_cells(cells: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    """Put the cells of a row into columns of given widths, two spaces apart.

    Args:
        cells: Texts; one that is too long is cut off with an ellipsis.
        widths: Characters of each column.
        right: Whether each column is aligned right.
    """
    parts = []
    for cell, width, is_right in zip(cells, widths, right, strict=True):
        text = f"{cell[: width - 1]}…" if len(cell) > width else cell
        parts.append(text.rjust(width) if is_right else text.ljust(width))
    return "  ".join(parts).rstrip()
