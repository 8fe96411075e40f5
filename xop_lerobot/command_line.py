"""What the commands of this project share: a parser whose errors are the project's own."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from xop_lerobot.errors import BadValue, UnknownName


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
