"""Compare the planner's time per solve with that of pytorch_mppi's KMPPI.

    python -m benchmarks.run_planner --repeats 500

Medians of interleaved solves on one thread, without physics and policy. Needs the extra `dev`.
"""

from __future__ import annotations

import argparse

from benchmarks.planner import make_planner_table, measure_planners
from xop_lerobot.core.command_line import make_output_readable


def main() -> None:
    """Time both planners and print a Markdown table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=300, help="solves per planner and row")
    parser.add_argument("--seed", type=int, default=0)
    settings = parser.parse_args()
    print(make_planner_table(measure_planners(repeats=settings.repeats, seed=settings.seed)))


if __name__ == "__main__":
    make_output_readable()
    main()
