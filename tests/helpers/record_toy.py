"""Run a recording command with the toy robot known: `record_toy.py xop-record|lerobot-record`."""

import sys
from pathlib import Path

REPO = Path(__file__).parents[2]
for folder in ("tests/helpers", "teleoperators", "robots", "."):
    sys.path.insert(0, str(REPO / folder))

import toy_robot  # noqa: E402, F401


def main() -> None:
    command = sys.argv.pop(1)
    if command == "xop-record":
        from xop_lerobot.recording.record import main as run
    else:
        from lerobot.scripts.lerobot_record import main as run
    run()


if __name__ == "__main__":
    main()
