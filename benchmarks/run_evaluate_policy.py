r"""Compare policies by the distance of their hands from their target points, episode by episode.

    python -m benchmarks.run_evaluate_policy --at 6 --rollouts trained=outputs/rollout_trained \
        untrained=outputs/rollout_untrained

Each of --rollouts is a dataset that `lerobot-rollout` recorded with a simulated robot of this
project, in a task with two target points (docs/use/training.md). All must have the same seeds. The
first is compared with each of the others, with a robot that stands still, and with the best fixed
places for these episodes, found in hindsight. With --margin the exit code is 1 unless the first is
nearer than the other rollouts and the standing robot by at least that much, at the lower end of the
95% interval.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.core.command_line import make_output_readable, split_pair
from xop_lerobot.core.errors import BadValue, XopError

if TYPE_CHECKING:
    from benchmarks.policy_error import Hands

STILL, BLIND = "stand still", "best without looking"


def read_rollouts(texts: list[str], at: float) -> dict[str, Hands]:
    """Read the hands of rollouts given as `NAME=DIRECTORY`.

    Raises:
        BadValue: If one is malformed, or the rollouts differ in their settings or episodes.
    """
    from benchmarks.policy_error import read_hands

    found: dict[str, Hands] = {}
    for text in texts:
        form = "--rollouts takes NAME=DIRECTORY, each name once"
        name, root = split_pair(text, form)
        if name in found:
            raise BadValue(f"{form}, got '{text}'")
        found[name] = read_hands(Path(root), at)
    first, *others = found.items()
    for name, hands in others:
        for key in ("robot", "task", "scene", "noise", "low_level", "fps", "seed"):
            mine, its = (getattr(each.setting, key) for each in (first[1], hands))
            if mine != its:
                raise BadValue(f"{first[0]} has {key} {mine} and {name} {its}: not comparable")
        if not np.array_equal(first[1].episodes, hands.episodes):
            raise BadValue(f"{first[0]} and {name} do not have the same episodes")
    return found


def evaluate(rollouts: dict[str, Hands], at: float) -> dict[str, Any]:
    """Compute errors and margins of all rollouts, as values for JSON."""
    from benchmarks.policy_error import (
        compute_best_blind_error,
        compute_margin,
        stand_still,
    )
    from xop_lerobot.evaluation.summary import compute_mean_interval

    first = next(iter(rollouts))
    setting, episodes = rollouts[first].setting, rollouts[first].episodes
    contestants = {**rollouts, STILL: stand_still(setting, episodes.tolist(), at)}
    rows, errors = {}, {}
    for name, hands in contestants.items():
        errors[name] = hands.compute_errors()
        rows[name] = {
            "error": float(errors[name].mean()),
            "interval": list(compute_mean_interval(errors[name].tolist())),
            "elsewhere": float(hands.compute_errors_elsewhere().mean()),
            "success": int(hands.success.sum()),
            "falls": int(hands.fallen.sum()),
            "errors": errors[name].tolist(),
        }
    blind = compute_best_blind_error(rollouts[first].points)
    rivals = {name: errors[name] for name in errors if name != first}
    rivals[BLIND] = np.full(len(episodes), blind)
    margins = {}
    for name, values in rivals.items():
        margin = compute_margin(errors[first], values)
        margins[name] = {**dataclasses.asdict(margin), "interval": list(margin.interval)}
    return {
        **dataclasses.asdict(setting),
        "episodes": len(episodes),
        "at": at,
        "policies": rows,
        "best_blind_error": blind,
        "margins": margins,
    }


def print_table(result: dict[str, Any]) -> None:
    """Print the result of `evaluate` as text."""
    count, first = result["episodes"], next(iter(result["policies"]))
    print(
        f"{result['task']} with xop_{result['robot']}, seed {result['seed']}, {count} episodes, "
        f"at {result['at']:g} s"
    )
    print(
        "mean distance of the hands from their points, and from those of the other episodes [m]\n"
    )
    print(f"{'':22}{'own points':>10}{'95%':>18}{'others':>10}{'success':>10}{'falls':>8}")
    for name, row in result["policies"].items():
        low, high = row["interval"]
        print(
            f"{name:22}{row['error']:10.3f}{f'{low:.3f} to {high:.3f}':>18}"
            f"{row['elsewhere']:10.3f}{row['success']:>10}{row['falls']:>8}"
        )
    print(f"{BLIND:22}{result['best_blind_error']:10.3f}\n")
    for name, margin in result["margins"].items():
        low, high = margin["interval"]
        print(
            f"{first} is nearer than {name} by {margin['mean']:.3f} m ({low:.3f} to {high:.3f}), "
            f"in {margin['nearer']} of {margin['episodes']} episodes"
        )


def main() -> None:
    """Evaluate the rollouts, print the result, and write it as JSON if requested."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rollouts", nargs="+", required=True, metavar="NAME=DIRECTORY")
    parser.add_argument("--at", type=float, default=6.0, help="evaluated time of an episode [s]")
    parser.add_argument("--margin", type=float, help="required margin over each other rollout [m]")
    parser.add_argument("--json", type=Path, help="file for the results (default: none)")
    settings = parser.parse_args()
    try:
        result = evaluate(read_rollouts(settings.rollouts, settings.at), settings.at)
    except XopError as error:
        raise SystemExit(f"error: {error}") from error
    print_table(result)
    if settings.json is not None:
        settings.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if settings.margin is not None:
        rivals = {key: margin for key, margin in result["margins"].items() if key != BLIND}
        least = min(margin["interval"][0] for margin in rivals.values())
        print(f"smallest margin {least:.3f} m, required {settings.margin:.3f} m")
        sys.exit(0 if least >= settings.margin else 1)


if __name__ == "__main__":
    make_output_readable()
    main()
