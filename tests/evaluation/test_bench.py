"""`xop-bench`: its figures, its bare rollout, its command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.state import RobotState
from xop_lerobot.evaluation import bench
from xop_lerobot.evaluation.bench import (
    BareRollout,
    BenchConfig,
    main,
    make_parser,
    parse_arguments,
    run_bench,
)
from xop_lerobot.evaluation.bench_report import KEYS, make_bench_blocks, summarise
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.rollout import PolicyRollout

CONTRACT = {
    "step_ms_median", "step_ms_p99", "rollout_ms_median", "physics_ms_median",
    "policy_ms_median", "overhead_ratio", "control_hz",
}  # fmt: skip


def make_rows(n=101):
    """Steps of 1 to n ms, each with a bare rollout of half of it."""
    return [
        {
            "step": i / 1000, "sync": 0.1 * i / 1000, "solve": 0.9 * i / 1000,
            "proposal": 0.1 * i / 1000, "rollout": 0.7 * i / 1000, "policy": 0.1 * i / 1000,
            "physics": 0.5 * i / 1000, "cost": 0.05 * i / 1000, "bare": 0.5 * i / 1000,
        }
        for i in range(1, n + 1)
    ]  # fmt: skip


def test_the_figures_of_known_times():
    figures = summarise(make_rows())
    assert set(KEYS) == CONTRACT
    assert figures["step_ms_median"] == pytest.approx(51)
    assert figures["step_ms_p99"] == pytest.approx(100)
    assert figures["rollout_ms_median"] == pytest.approx(25.5)
    assert figures["physics_ms_median"] == pytest.approx(25.5)
    assert figures["policy_ms_median"] == pytest.approx(5.1)
    assert figures["overhead_ratio"] == pytest.approx(2)
    assert figures["control_hz"] == pytest.approx(1000 / 51)
    assert figures["control_hz_p99"] == pytest.approx(10)
    assert figures["sync_ms_median"] == pytest.approx(5.1)
    assert figures["overhead_ratio_p25"] == figures["overhead_ratio_p75"] == pytest.approx(2)


def test_the_profile_adds_up_to_the_step():
    figures = summarise(make_rows())
    profile = figures["profile"]
    assert sum(profile.values()) == pytest.approx(figures["step_ms_median"])
    assert profile["rollout, rest"] == pytest.approx(5.1)
    assert profile["cost"] == pytest.approx(0.05 * 51)
    assert profile["other"] == pytest.approx(51 * 0.05)
    assert set(profile) == {
        "state sync", "physics", "low-level policy", "rollout, rest", "proposal", "cost", "other"
    }  # fmt: skip


def test_the_ratio_is_of_medians_and_not_moved_by_a_slow_step():
    rows = make_rows()
    rows[-1]["step"] = 10.0
    assert summarise(rows)["overhead_ratio"] == pytest.approx(2)
    assert summarise(rows)["step_ms_p99"] < 200


def make_state(morphology, policy) -> RobotState:
    rest = morphology.rest_action()
    qpos, nv = morphology.standing_qpos(), build_model(morphology, "planning").nv
    return RobotState(
        time=0.0, qpos=qpos, qvel=np.zeros(nv), memory=policy.initial_memory(1)[0],
        command=rest.command, arms=rest.arms, mode=Mode.STATIONARY, effort=np.zeros(0),
        true_qpos=qpos, true_qvel=np.zeros(nv), wall_time=0.0,
    )  # fmt: skip


def test_the_bare_rollout_is_that_of_the_planner_in_one_call():
    morphology, policy = make_morphology("rby1"), make_policy("diff_drive")
    rollout = PolicyRollout(build_model(morphology, "planning"), policy, 1)
    bare = BareRollout(rollout, 1)
    state = make_state(morphology, policy)
    rng = np.random.default_rng(0)
    commands = state.command + 0.1 * rng.standard_normal((3, 4, len(state.command)))
    predict = (state.qpos, state.qvel, state.memory, commands, state.arms, Mode.MOBILE)
    prediction = rollout.predict(*predict)
    out = {}

    class Spy:
        def rollout(self, model, data, start, controls, state):
            bare_pool.rollout(model, data, start, controls, state=state)
            out["state"], out["controls"] = state, controls

    bare_pool, vars(bare)["_pool"] = bare._pool, Spy()
    assert bare.run(state, 3, 4) > 0
    nq = rollout.model.nq
    assert out["controls"].shape == (3, 4 * rollout.substeps, rollout.model.nu)
    ends = out["state"][:, rollout.substeps - 1 :: rollout.substeps, 1 : 1 + nq]
    np.testing.assert_allclose(ends, prediction.qpos[:, 1:], atol=1e-6)
    rollout.predict(*predict)
    with pytest.raises(BadValue, match="must ask the policy 4 times for 3 x"):
        bare.run(state, 3, 4)  # two solves were heard
    bare.forget()
    rollout.predict(*predict)
    bare.run(state, 3, 4)
    rollout.close()


@pytest.mark.parametrize(("robot", "mode"), [("g1", "mobile"), ("rby1", "stationary")])
def test_a_tiny_run_writes_the_contract(robot, mode, tmp_path, capsys):
    path = tmp_path / "sub" / "bench.json"
    flags = ["--robot", robot, "--mode", mode, "--samples", "6", "--horizon", "2", "--threads",
             "1", "--steps", "4", "--warmup", "1", "--json", str(path), "--profile"]  # fmt: skip
    assert main(flags) == 0
    figures = json.loads(path.read_text())
    assert set(figures) >= CONTRACT
    assert all(isinstance(figures[key], float) and figures[key] > 0 for key in CONTRACT)
    assert (figures["samples"], figures["horizon"], figures["threads"]) == (6, 2, 1)
    assert (figures["robot"], figures["mode"]) == (robot, mode)
    substeps = round(POLICY_DT / build_model(make_morphology(robot), "planning").opt.timestep)
    assert figures["physics_steps"] == 6 * 2 * substeps
    assert figures["overhead_ratio"] == pytest.approx(
        figures["step_ms_median"] / figures["rollout_ms_median"]
    )
    assert figures["step_ms_median"] > figures["physics_ms_median"]
    assert "mujoco" in figures["machine"]
    output = capsys.readouterr().out
    assert all(key in output for key in CONTRACT)
    assert "low-level policy" in output


def test_zeros_take_the_robots_own_numbers(monkeypatch):
    monkeypatch.setattr(bench, "_time_solves", lambda *args: make_rows(3))
    figures = run_bench(BenchConfig("g1", Mode.MOBILE))
    own = make_morphology("g1").mpc_config(Mode.MOBILE)
    assert (figures["samples"], figures["horizon"]) == (own.num_samples, own.horizon)
    assert figures["wanted_hz"] == own.control_hz


def test_help_shows_every_flag_with_unit_and_default():
    text = " ".join(make_parser().format_help().split())
    for flag in ("--robot", "--mode", "--samples", "--horizon", "--threads", "--json",
                 "--profile", "--steps", "--seed", "--preset", "--scene", "--noise"):  # fmt: skip
        assert flag in text
    assert "[steps of 20 ms]" in text
    assert "times in ms" in text
    assert text.count("default: ") >= 9


def test_wrong_flags_and_values_are_told(capsys):
    cases = {
        "--foo 3": "unknown flag of xop-bench '--foo'. Known: --help, --horizon, --json,",
        "--samples x": "argument --samples: invalid int value: 'x'",
        "--samples -1": "samples must be at least 0, got -1",
        "--steps 0": "steps must be at least 1, got 0",
        "--preset best": "unknown preset 'best'. Known: ",
        "--noise much": "unknown noise preset 'much'. Known: ",
        "--scene moon": "unknown scene 'moon'. Known: ",
    }
    for flags, text in cases.items():
        assert main(["--robot", "g1", "--mode", "mobile", *flags.split()]) == 2
        assert text in capsys.readouterr().err
    assert main(["--robot", "g1", "--mode", "flying"]) == 2
    assert "unknown mode 'flying'. Known: mobile, stationary" in capsys.readouterr().err
    assert main(["--robot", "g2", "--mode", "mobile"]) == 2
    assert "unknown robot 'g2'. Known: g1, rby1" in capsys.readouterr().err
    assert main(["--robot", "g1"]) == 2
    assert "the following arguments are required: --mode" in capsys.readouterr().err


def test_flags_are_not_abbreviated():
    with pytest.raises(UnknownName, match="'--sample'"):
        parse_arguments(["--robot", "g1", "--mode", "mobile", "--sample", "3"])


def test_the_tables_of_the_document():
    row = {
        **summarise(make_rows()), "robot": "g1", "mode": "mobile", "samples": 30, "horizon": 3,
        "threads": 2, "wanted_hz": 25.0, "steps": 101, "seed": 0, "noise": "mild",
        "machine": {"processor": "P", "cores": "2"},
    }  # fmt: skip
    blocks = make_bench_blocks([row, row])
    assert blocks["bench machine"].startswith("P, cores 2. 101 solves per row")
    lines = blocks["bench"].splitlines()
    assert lines[2] == ("| g1, mobile | 30 × 3 | 2 | 51.0 | 100.0 | 25.5 | 2.00 | 20 | 10 | 25 |")
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {11}
    assert blocks["profile"].splitlines()[2].endswith("| 51.00 |")
    text = (Path(__file__).resolve().parents[2] / "docs" / "results" / "benchmarks.md").read_text()
    for name in blocks:
        assert f"<!-- begin {name} -->" in text
