"""Time of the planner alone, compared with pytorch_mppi's KMPPI on the same system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.kmppi import Kmppi

ENTRIES = 7
"""Entries of a command, as many as G1 has."""
CASES = ((30, 3, 1), (30, 3, 3), (30, 5, 2), (30, 10, 5), (128, 3, 1), (128, 10, 5))
"""Samples K, steps T and support points S of each row; S = T // 2 is pytorch_mppi's default."""

BLOCK = 20
"""Consecutive solves of one planner before the other is timed."""

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "table1": {
        "kernel_mean": "zero",
        "shift": "one",
        "sampling": "gaussian",
        "sample_plan": False,
        "weighting": "raw",
        "importance_cost": True,
    },
}
"""Settings of our planner: its defaults, and those with which it equals pytorch_mppi's KMPPI."""


@dataclass(frozen=True)
class PlannerTime:
    """Time of one solve without physics and policy, medians over interleaved blocks.

    Attributes:
        setting: Name in `SETTINGS`.
        samples: Number of samples K.
        horizon: Number of steps T.
        knots: Number of support points S.
        ours_us: Ours: shift, sample, update, and reading the command [µs].
        theirs_us: `command()` of pytorch_mppi's KMPPI [µs].
        theirs_without_rollouts_us: The same less the time of its rollouts [µs].
    """

    setting: str
    samples: int
    horizon: int
    knots: int
    ours_us: float
    theirs_us: float
    theirs_without_rollouts_us: float

    @property
    def ratio(self) -> float:
        """Time of their whole `command()` over ours."""
        return self.theirs_us / self.ours_us

    @property
    def ratio_without_rollouts(self) -> float:
        """Time of their `command()` less its rollouts over ours."""
        return self.theirs_without_rollouts_us / self.ours_us


def measure_planners(
    cases: Sequence[tuple[int, int, int]] = CASES, repeats: int = 300, seed: int = 0
) -> list[PlannerTime]:
    """Time both planners on one thread, on a system with constant state.

    The cost of a step is an entry of the state, which differs between samples, so what is left is
    the planner: shift, noise, interpolation, weights and update. Blocks of `BLOCK` solves
    alternate, so that other load on the machine slows both; the first three solves of a block,
    which find the other planner's code in the caches, do not count.

    Args:
        cases: Samples, steps and support points of each row.
        repeats: Solves of either planner per row.
        seed: Seed of states and noise.

    Raises:
        ModuleNotFoundError: If pytorch_mppi is not installed; the extra `dev` has it.
    """
    import torch  # noqa: PLC0415

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [_measure(name, *case, repeats, seed) for case in cases for name in SETTINGS]
    finally:
        torch.set_num_threads(threads)


def _measure(
    setting: str, samples: int, horizon: int, knots: int, repeats: int, seed: int
) -> PlannerTime:
    ours = make_ours(setting, samples, horizon, knots, seed)
    theirs = make_theirs(samples, horizon, knots, seed)
    rows = []
    for _ in range(max(1, repeats // BLOCK)):
        turns = [[_time(solve) for _ in range(BLOCK)][3:] for solve in (ours, theirs)]
        rows += [
            (mine - spent, whole, whole - rollout)
            for (mine, spent), (whole, rollout) in zip(*turns, strict=True)
        ]
    times = 1e6 * np.median(rows, axis=0)
    return PlannerTime(setting, samples, horizon, knots, *map(float, times))


def _time(solve: Callable[[], float]) -> tuple[float, float]:
    """Return the time of one solve and the part of it spent in rollouts [s]."""
    start = perf_counter()
    rollout = solve()
    return perf_counter() - start, rollout


def _step(state: Any, command: Any) -> Any:
    """Return the state unchanged; for arrays of numpy and of torch."""
    return state


def _cost(state: Any, command: Any) -> Any:
    return state[:, 0]


def make_ours(
    setting: str, samples: int, horizon: int, knots: int, seed: int
) -> Callable[[], float]:
    """Return a function that solves once with our planner and returns its rollouts' time [s]."""
    config = MpcConfig(
        num_samples=samples,
        horizon=horizon,
        noise_std={},
        num_knots=knots,
        kernel_width=1.0,
        **SETTINGS[setting],
    )
    planner = Kmppi(horizon, -np.ones(ENTRIES), np.ones(ENTRIES), config)
    planner.reset(np.zeros(ENTRIES))
    rng = np.random.default_rng(seed)
    noise, candidates = np.full(ENTRIES, 0.1), np.zeros((0, ENTRIES))
    # One state per sample, so that costs differ and the temperature search has work to do.
    start = rng.standard_normal((samples, ENTRIES))

    def solve() -> float:
        planner.shift(1)
        drawn = planner.sample(rng, noise, candidates)
        begin = perf_counter()
        state, costs = start, np.zeros(samples)
        for k in range(horizon):
            command = drawn.commands[:, k]
            state = _step(state, command)
            costs += _cost(state, command)
        end = perf_counter()
        planner.update(drawn, costs)
        planner.commands  # noqa: B018  (lazily interpolated: part of what a robot would wait for)
        return end - begin

    return solve


def make_theirs(samples: int, horizon: int, knots: int, seed: int) -> Callable[[], float]:
    """Return a function that solves once with pytorch_mppi's KMPPI, as `make_ours` does."""
    import torch  # noqa: PLC0415
    from pytorch_mppi.mppi import KMPPI, RBFKernel  # noqa: PLC0415

    torch.manual_seed(seed)
    bound = torch.ones(ENTRIES, dtype=torch.double)
    spent = [0.0]

    class Timed(KMPPI):
        def _compute_rollout_costs(self, perturbed_actions: Any) -> Any:
            begin = perf_counter()
            result = super()._compute_rollout_costs(perturbed_actions)
            spent[0] = perf_counter() - begin
            return result

    planner = Timed(
        _step,
        _cost,
        ENTRIES,
        0.01 * torch.eye(ENTRIES, dtype=torch.double),
        num_samples=samples,
        horizon=horizon,
        num_support_pts=knots,
        kernel=RBFKernel(sigma=1),
        lambda_=0.05,
        u_min=-bound,
        u_max=bound,
        U_init=torch.zeros(horizon, ENTRIES, dtype=torch.double),
    )
    start = np.random.default_rng(seed).standard_normal((samples, ENTRIES))
    state = torch.from_numpy(start)

    def solve() -> float:
        planner.command(state)
        return spent[0]

    return solve


def make_planner_table(times: Sequence[PlannerTime]) -> str:
    """Format `times` as a Markdown table."""
    lines = [
        "| K × T, S | setting | ours [µs] | KMPPI [µs] | ratio | less rollouts [µs] | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.samples} × {row.horizon}, {row.knots} | {row.setting} | {row.ours_us:.0f} "
        f"| {row.theirs_us:.0f} | {row.ratio:.1f} "
        f"| {row.theirs_without_rollouts_us:.0f} | {row.ratio_without_rollouts:.1f} |"
        for row in times
    ]
    return "\n".join(lines)
