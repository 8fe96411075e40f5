"""`xop-curate`: inspect, filter, trim, merge, split, repair, label and retarget recorded datasets.

    xop-curate VERB --root DIR [--out DIR] ...

No verb changes the dataset that it reads, unless `--in-place` is given. The new dataset is written
to a temporary folder and moved into place when complete, so a crash leaves everything unchanged.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from typing import Protocol, cast

from xop_lerobot.core.command_line import INTERRUPTED, CommandParser, make_output_readable
from xop_lerobot.core.errors import BadValue, UnknownName, XopError
from xop_lerobot.core.shutdown import stop_on_sigterm

_PACKAGE = "xop_lerobot.curate"
VERBS = {
    "inspect": "inspect",
    "filter": "filter",
    "trim": "trim",
    "merge": "merge",
    "split": "split",
    "repair": "repair",
    "label": "label",
    "retarget": "retarget",
    "report": "report",
}
"""Module of each verb, in the order of the help."""


class Verb(Protocol):
    """Interface of a verb's module; its docstring heads its own `--help`.

    Modules are imported for `--help`, so slow imports (LeRobot, MuJoCo) belong into `run`.
    """

    SUMMARY: str
    """One line in the list of verbs."""

    def add_arguments(self, parser: CommandParser) -> None:
        """Add the verb's flags."""
        ...

    def run(self, arguments: argparse.Namespace) -> int:
        """Perform the verb; returns the exit code."""
        ...


def load_verb(name: str) -> Verb:
    """Import a verb's module.

    Raises:
        UnknownName: Listing the known verbs.
    """
    if name not in VERBS:
        raise UnknownName("verb of xop-curate", name, VERBS)
    return cast("Verb", importlib.import_module(f"{_PACKAGE}.{VERBS[name]}"))


WRONG_USAGE = 2
"""Exit code of an invalid command line."""


def make_parser() -> CommandParser:
    """Make the parser of the command without a verb, which accepts `--help` alone."""
    width = max(map(len, VERBS), default=0)
    lines = [f"  {name:{width}}  {load_verb(name).SUMMARY}" for name in VERBS]
    parser = CommandParser(
        "xop-curate",
        __doc__,
        usage="xop-curate VERB [flags]",
        epilog="verbs:\n" + "\n".join(lines) + "\n\n`xop-curate VERB --help` lists its flags.",
    )
    return parser


def make_verb_parser(name: str, verb: Verb) -> CommandParser:
    """Make the parser of one verb's flags."""
    text = verb.__doc__ or verb.SUMMARY
    parser = CommandParser(f"xop-curate {name}", text)
    verb.add_arguments(parser)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `xop-curate`; returns the exit code."""
    make_output_readable()
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if not words or words[0].startswith("-"):
            parser = make_parser()
            parser.parse(words)
            raise BadValue(f"a verb is missing. Known: {', '.join(VERBS)}")
        verb = load_verb(words[0])
        parsed = make_verb_parser(words[0], verb).parse(words[1:])
    except XopError as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_USAGE
    try:
        with stop_on_sigterm():
            return verb.run(parsed)
    except KeyboardInterrupt:
        print("interrupted; nothing was changed", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # such as `xop-curate inspect … | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (XopError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return WRONG_USAGE if isinstance(error, BadValue | UnknownName) else 1


if __name__ == "__main__":
    sys.exit(main())
