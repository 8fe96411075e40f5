"""A user's mistake ends LeRobot's commands in one line that names it.

LeRobot lets every error end in a traceback and wraps those of a device's constructor in its whole
configuration, so that what is wrong stands at the end of some forty lines. `XOP_TRACEBACK=1`
brings the traceback back.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import TracebackType

from xop_lerobot.core.command_line import make_output_readable
from xop_lerobot.core.errors import XopError

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
