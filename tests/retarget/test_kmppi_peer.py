"""Our KMPPI equals that of pytorch_mppi, in the setting that it has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.planner import SETTINGS, make_planner_table, measure_planners
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.kmppi import DRAWS, Kmppi, compute_effective_samples

torch = pytest.importorskip("torch")
peer = pytest.importorskip("pytorch_mppi.mppi", reason="the dev extra has pytorch-mppi")

COMMANDS = 20
TOLERANCE = 1e-10

# A linear system at the edge of stability that is to be brought to a point.
STATES, ENTRIES = 6, 7
_problem = np.random.default_rng(7)
TRANSITION = np.eye(STATES) + 0.1 * _problem.standard_normal((STATES, STATES))
TRANSITION /= np.abs(np.linalg.eigvals(TRANSITION)).max()
INPUT = 0.3 * _problem.standard_normal((ENTRIES, STATES))
WEIGHTS = _problem.uniform(0.1, 1.0, STATES)
START = _problem.standard_normal(STATES)
NOISE_STD = _problem.uniform(0.05, 0.3, ENTRIES)
NO_CANDIDATES = np.zeros((0, ENTRIES))


@dataclass(frozen=True)
class Case:
    """One setting of both planners."""

    samples: int = 30
    horizon: int = 5
    knots: int = 3
    width: float = 1.5
    temperature: float = 0.05
    bound: float = 0.3
    terminal: bool = True
    noise: float = 1.0


CASES = {
    "S < T": Case(),
    "S = T": Case(horizon=3, knots=3, width=1.0),
    "one knot": Case(horizon=3, knots=1, width=1.0),
    "batch of 128": Case(samples=128, horizon=10, knots=5),
    "never clipped": Case(bound=100.0),
    "nearly always clipped": Case(bound=0.05, noise=4.0),
    "no terminal cost": Case(terminal=False),
    "hot, so that the importance cost counts": Case(temperature=5.0, noise=0.3, bound=0.1),
    "cold": Case(temperature=1e-3),
}
cases = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


def dynamics(state, command):
    """The same for arrays of numpy and of torch."""
    if isinstance(state, np.ndarray):
        return state @ TRANSITION + command @ INPUT
    return state @ torch.from_numpy(TRANSITION) + command @ torch.from_numpy(INPUT)


def running_cost(state, command):
    weights = WEIGHTS if isinstance(state, np.ndarray) else torch.from_numpy(WEIGHTS)
    return (weights * (state - 0.2) ** 2).sum(-1) + 0.01 * (command**2).sum(-1)


def terminal_cost(states):
    weights = WEIGHTS if isinstance(states, np.ndarray) else torch.from_numpy(WEIGHTS)
    return 5 * (weights * (states - 0.2) ** 2).sum(-1)


@pytest.fixture(autouse=True)
def torch_normals(monkeypatch):
    """Gaussian noise comes from torch's generator, as with the other planner."""
    monkeypatch.setitem(
        DRAWS, "gaussian", lambda _, shape: torch.randn(*shape, dtype=torch.double).numpy()
    )


def record_theirs(case: Case) -> list[dict[str, np.ndarray]]:
    bound = torch.full((ENTRIES,), case.bound, dtype=torch.double)
    planner = peer.KMPPI(
        dynamics,
        running_cost,
        STATES,
        torch.diag(torch.from_numpy((case.noise * NOISE_STD) ** 2)),
        num_samples=case.samples,
        horizon=case.horizon,
        num_support_pts=case.knots,
        kernel=peer.RBFKernel(sigma=case.width),
        lambda_=case.temperature,
        u_min=-bound,
        u_max=bound,
        U_init=torch.zeros(case.horizon, ENTRIES, dtype=torch.double),
        terminal_state_cost=(lambda states, _: terminal_cost(states[0, :, -1]))
        if case.terminal
        else None,
    )
    state, rows = START, []
    for i in range(COMMANDS):
        torch.manual_seed(100 + i)
        command = planner.command(torch.from_numpy(state)).numpy()
        state = dynamics(state, command)
        rows.append(
            {
                "theta": planner.theta.numpy(),
                "U": planner.U.numpy(),
                "weights": planner.omega.numpy(),
                "costs": planner.cost_total.numpy(),
                "commands": planner.perturbed_action.numpy(),
                "state": state,
            }
        )
    return rows


def record_ours(case: Case, **changes) -> list[dict[str, np.ndarray]]:
    settings = {
        "kernel_mean": "zero",
        "shift": "one",
        "sampling": "gaussian",
        "sample_plan": False,
        "weighting": "raw",
        "importance_cost": True,
    }
    config = MpcConfig(
        num_samples=case.samples,
        horizon=case.horizon,
        noise_std={},
        num_knots=case.knots,
        kernel_width=case.width,
        temperature=case.temperature,
        **(settings | changes),
    )
    bound = np.full(ENTRIES, case.bound)
    planner = Kmppi(case.horizon, -bound, bound, config)
    planner.reset(np.zeros(ENTRIES))
    rng, state, rows = np.random.default_rng(0), START, []
    for i in range(COMMANDS):
        torch.manual_seed(100 + i)
        planner.shift(2.0)  # solved every second step; `shift="one"` takes no notice
        samples = planner.sample(rng, case.noise * NOISE_STD, NO_CANDIDATES)
        costs, states = np.zeros(case.samples), np.tile(state, (case.samples, 1))
        for k in range(case.horizon):
            states = dynamics(states, samples.commands[:, k])
            costs += running_cost(states, samples.commands[:, k])
        if case.terminal:
            costs += terminal_cost(states)
        weights = planner.update(samples, costs)
        state = dynamics(state, planner.nominal[0])
        rows.append(
            {
                "theta": planner.knots,
                "U": planner.nominal,
                "weights": weights,
                "costs": costs if samples.penalty is None else costs + samples.penalty,
                "commands": samples.commands,
                "state": state,
            }
        )
    return rows


def find_difference(ours, theirs) -> float:
    return max(
        float(np.abs(a[name] - b[name]).max())
        for a, b in zip(ours, theirs, strict=True)
        for name in b
    )


@cases
def test_twenty_closed_loop_commands_are_the_same(case):
    ours, theirs = record_ours(case), record_theirs(case)
    for i, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        for name in b:
            np.testing.assert_allclose(
                a[name], b[name], rtol=0, atol=TOLERANCE, err_msg=f"{name} of command {i}"
            )


@cases
def test_the_cases_are_no_trivial_ones(case):
    """More than one sample counts somewhere, the plan moves, and bounds act where they should."""
    rows = record_ours(case)
    effective = [compute_effective_samples(row["weights"]) for row in rows]
    assert 1.0 < max(effective) < case.samples
    assert np.abs(rows[-1]["theta"]).max() > 1e-3
    clipped = np.mean([np.abs(row["commands"]) == case.bound for row in rows])
    assert clipped == 0 if case.bound > 1 else clipped > 0.02


@pytest.mark.parametrize(
    "change",
    [
        {"kernel_mean": "hold"},
        {"shift": "measured"},
        {"sampling": "antithetic"},
        {"sample_plan": True},
        {"weighting": "ess"},
        {"importance_cost": False},
    ],
    ids=str,
)
def test_every_other_setting_differs(change):
    """The comparison sees each of them, so it would see a mistake."""
    case = Case(temperature=0.5)
    theirs = record_theirs(case)
    assert find_difference(record_ours(case), theirs) < TOLERANCE
    assert find_difference(record_ours(case, **change), theirs) > 1e-3


def test_the_comparison_of_times_has_a_row_per_case_and_setting():
    times = measure_planners(((12, 3, 1), (12, 4, 2)), repeats=20)
    assert [(row.setting, row.samples, row.horizon, row.knots) for row in times] == [
        (setting, *case) for case in ((12, 3, 1), (12, 4, 2)) for setting in SETTINGS
    ]
    for row in times:
        assert 0 < row.ours_us
        assert 0 < row.theirs_without_rollouts_us < row.theirs_us
        assert row.ratio == row.theirs_us / row.ours_us
    assert len(make_planner_table(times).splitlines()) == 6
