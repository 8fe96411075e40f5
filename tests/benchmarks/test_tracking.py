"""The tracking benchmark: goals, figures of trajectories whose figures are known, settings."""

import dataclasses
import math

import numpy as np
import pytest

from benchmarks.tracking_metrics import (
    Trajectory,
    compute_errors,
    compute_metrics,
    compute_step_metrics,
)
from benchmarks.tracking_scenarios import (
    ROOM_HALF,
    SCENARIO_GROUPS,
    SCENARIOS,
    GoalStep,
    GoalTrack,
    Tolerance,
)
from benchmarks.tracking_setup import (
    ABLATIONS,
    TrackingSetup,
    compute_policy_steps,
    make_retargeter_config,
    make_tuned_morphology,
    override_config,
    parse_overrides,
    resolve_configs,
)
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadShape, BadValue, UnknownName
from xop_lerobot.core.transforms import (
    make_pose,
    quat_from_rpy,
    quat_from_yaw,
    quat_rotate,
    quat_yaw,
)
from xop_lerobot.evaluation.bench import (
    CURVE_SPEED,
    CURVE_TURN,
    LEAD_IN_S,
    WAIST,
    bend_from,
    make_curve,
    move_from,
)
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.retarget.arms.contact import ArmHold
from xop_lerobot.retarget.config import RetargeterConfig

HOME = make_pose(np.array([1.0, 2.0, 1.25]), quat_from_yaw(0.7))
DT = 0.04
TOLERANCE = Tolerance(0.05, math.radians(3))


def make_trajectory(time, head, goal, **other) -> Trajectory:
    """A robot whose base and feet stay, unless told otherwise."""
    n = len(time)
    still = np.tile(make_pose(np.array([0, 0, 0.75]), np.array([1.0, 0, 0, 0])), (n, 1))
    values = {
        "base": still,
        "command": np.zeros((n, 2)),
        "feet": np.zeros((n, 2, 3)),
        "hands": np.full((n, 2), 0.01),
        "fallen": np.zeros(n, dtype=bool),
        "collision": np.zeros(n, dtype=bool),
        "solve_s": np.array([0.01, 0.02, 0.03]),
    }
    return Trajectory(time=time, head=head, goal=goal, **(values | other))


def hold(pose, n) -> np.ndarray:
    return np.tile(pose, (n, 1))


# -- scenarios -----------------------------------------------------------------------------------


def build(name, hold_s=10.0, goals=20, seed=0):
    return SCENARIOS[name].build(HOME, np.random.default_rng(seed), hold_s, goals)


def in_home(pose) -> np.ndarray:
    return quat_rotate(quat_from_yaw(-0.7), pose[:3] - HOME[:3])


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_starts_at_home_and_ends_after_its_goals(name):
    track = build(name)
    np.testing.assert_allclose(track.head_at(0.0), HOME)
    np.testing.assert_allclose(track.head_at(LEAD_IN_S - 0.01), HOME)
    assert track.duration > LEAD_IN_S
    starts = [step.start for step in track.steps]
    assert starts == sorted(starts)
    assert all(step.start + step.limit_s <= track.duration for step in track.steps)
    assert name in [each for group in SCENARIO_GROUPS.values() for each in group]


def test_stationary_goals_are_those_of_the_issue():
    down, back = build("squat").steps
    np.testing.assert_allclose(in_home(down.head), [0, 0, -0.15], atol=1e-12)
    np.testing.assert_allclose(back.head, HOME)
    left, right, ahead = build("yaw").steps
    assert quat_yaw(left.head[3:]) == pytest.approx(1.2)
    assert quat_yaw(right.head[3:]) == pytest.approx(0.2)
    np.testing.assert_allclose(ahead.head, HOME)
    bent = build("pitch").steps[0]
    np.testing.assert_allclose(quat_yaw(bent.head[3:]), 0.7, atol=1e-12)
    assert {step.limit_s for step in build("pitch").steps} == {1.5}


@pytest.mark.parametrize(
    ("name", "offset", "yaw", "limit"),
    [
        ("diagonal", (0.8, 0.3, 0), 0.4, math.hypot(0.8, 0.3) / 0.5 + 3),
        ("ahead", (2, 0, 0), 0, 7),
        ("sideways", (0, 1, 0), 0, 5),
        ("quarter", (0, 0, 0), math.pi / 2, 3),
    ],
)
def test_mobile_goals_are_those_of_the_issue(name, offset, yaw, limit):
    (step,) = build(name, hold_s=60).steps
    np.testing.assert_allclose(in_home(step.head), offset, atol=1e-12)
    assert quat_yaw(step.head[3:]) - 0.7 == pytest.approx(yaw)
    assert step.limit_s == pytest.approx(limit)
    assert build(name, hold_s=60).duration == pytest.approx(LEAD_IN_S + limit + 60)


def test_a_bend_keeps_the_waist_where_it_is():
    waist = HOME[:3] + quat_rotate(HOME[3:], WAIST)
    for pitch, yaw in ((0.2, 0), (0, 0.5), (-0.3, 0.1)):
        pose = bend_from(HOME, pitch, yaw)
        np.testing.assert_allclose(pose[:3] + quat_rotate(pose[3:], WAIST), waist, atol=1e-12)
    forward = in_home(bend_from(HOME, pitch=0.2))
    ahead = 0.42 * math.sin(0.2) - 0.05 * (1 - math.cos(0.2))
    assert forward[0] == pytest.approx(ahead, abs=1e-9)
    assert abs(forward[1]) < 1e-12


def test_the_curve_has_its_speed_turn_rate_and_faces_along_itself():
    path = make_curve(HOME)
    times = LEAD_IN_S + np.arange(0.2, 19.8, 0.05)
    poses = np.array([path(time) for time in times])
    velocity = np.diff(poses[:, :2], axis=0) / 0.05
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), CURVE_SPEED, rtol=2e-3)
    heading = np.unwrap(quat_yaw(poses[:, 3:]))
    along = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    np.testing.assert_allclose((heading[1:] + heading[:-1]) / 2, along, atol=0.01)
    rates = np.abs(np.diff(heading)) / 0.05
    assert 0.95 * CURVE_TURN < rates.max() < 1.01 * CURVE_TURN
    np.testing.assert_allclose(path(LEAD_IN_S - 0.5), HOME)


def test_the_rooms_goals_are_a_quarter_of_a_metre_from_a_wall_and_inside():
    track = build("room", goals=100)
    assert len(track.steps) == 100
    places = np.array([step.head[:2] for step in track.steps])
    nearest = ROOM_HALF - np.abs(places).max(axis=1)
    np.testing.assert_allclose(nearest, 0.25, atol=1e-9)
    assert {round(float(step.head[2]), 6) for step in track.steps} == {1.25}
    walls = {(int(np.argmax(np.abs(p))), bool(p[np.argmax(np.abs(p))] > 0)) for p in places}
    assert len(walls) == 4
    assert not np.allclose(places, [s.head[:2] for s in build("room", goals=100, seed=1).steps])


def test_the_arms_scenario_differs_by_seed_and_reaches_forward():
    tracks = [build("arms", seed=seed) for seed in range(5)]
    assert len({float(track.steps[0].head[2]) for track in tracks}) == 5
    for track in tracks:
        assert track.reach is not None
        assert 0.35 <= track.reach[0] <= 0.45
        assert in_home(track.steps[0].head)[2] < -0.15


# -- figures -------------------------------------------------------------------------------------


def test_constant_offset_is_its_own_instant_and_mean_error():
    time = np.arange(0, 8, DT)
    head = hold(move_from(HOME, (0.03, 0.04, 0), 0.1), len(time))
    errors = compute_errors(make_trajectory(time, head, hold(HOME, len(time))))
    np.testing.assert_allclose(errors.position, 0.05, atol=1e-12)
    np.testing.assert_allclose(errors.mean_position, 0.05, atol=1e-12)
    np.testing.assert_allclose(errors.angle, 0.1, atol=1e-9)
    np.testing.assert_allclose(errors.mean_angle, 0.1, atol=1e-9)


def test_sway_cancels_in_the_mean_and_not_in_the_instant_error():
    time = np.arange(0, 10, DT)
    head = hold(HOME, len(time))
    head[:, 1] += 0.04 * np.sin(2 * np.pi * time)  # one sway per second: whole ones per window
    errors = compute_errors(make_trajectory(time, head, hold(HOME, len(time))))
    assert errors.position.max() == pytest.approx(0.04, rel=0.01)
    assert errors.mean_position[time >= 1].max() < 1e-9


def test_the_mean_does_not_reach_back_over_a_step_of_the_goal():
    time = np.arange(0, 6, DT)
    goal = hold(HOME, len(time))
    goal[time >= 3] = move_from(HOME, (1, 0, 0))
    head = goal.copy()
    head[time >= 3, 0] += 0.01
    errors = compute_errors(make_trajectory(time, head, goal), starts=[3.0])
    np.testing.assert_allclose(errors.mean_position[time >= 3], 0.01, atol=1e-9)
    across = compute_errors(make_trajectory(time, head, goal))
    assert across.mean_position[np.argmax(time >= 3)] < 0.01


def make_arrival(arrives: float, offset: float = 0.01, duration: float = 12.0):
    """A head that jumps to within `offset` of its goal `arrives` after the step at 1 s."""
    time = np.arange(0, duration, DT)
    goal = hold(HOME, len(time))
    target = move_from(HOME, (1, 0, 0), 0.4)
    goal[time >= 1 - 1e-9] = target
    head = hold(HOME, len(time))
    head[time >= 1 + arrives - 1e-9] = move_from(target, (0, offset, 0))
    step = GoalStep(1.0, target, direct_s=2.0, limit_s=5.0)
    return GoalTrack(HOME, duration, (step,)), make_trajectory(time, head, goal)


def test_arrival_lateness_and_what_comes_after():
    track, trajectory = make_arrival(arrives=4.0)
    metrics = compute_metrics(track, trajectory, TOLERANCE)
    assert metrics["arrival_s"] == pytest.approx(4.0)
    assert metrics["late_s"] == pytest.approx(2.0)
    assert 4.8 < metrics["arrival_mean_s"] <= 5.0  # a second of standing there, less the tolerance
    for name in ("at_limit_cm", "after_max_cm", "after_p95_cm", "after_median_cm", "final_cm"):
        assert metrics[name] == pytest.approx(1.0), name
    assert metrics["after_mean_max_cm"] == pytest.approx(1.0)
    assert metrics["after_max_deg"] == pytest.approx(0, abs=1e-6)
    assert metrics["outside_share"] == 0
    assert metrics["arrived_goals"] == metrics["goals"] == 1
    assert metrics["solve_ms"] == pytest.approx(20)
    assert metrics["hand_cm"] == pytest.approx(1)


def test_failed_and_vetoed_solves_are_counted():
    track, trajectory = make_arrival(arrives=1.0)
    flags = np.array([True, False, False, False])
    changed = dataclasses.replace(trajectory, failed=flags, intervened=~flags)
    metrics = compute_metrics(track, changed, TOLERANCE)
    assert (metrics["failed_percent"], metrics["intervened_percent"]) == (25, 75)
    assert compute_metrics(track, trajectory, TOLERANCE)["failed_percent"] == 0


def test_what_never_arrives_is_infinitely_late():
    track, trajectory = make_arrival(arrives=2.0, offset=0.06)
    metrics = compute_metrics(track, trajectory, TOLERANCE)
    assert metrics["arrival_s"] == metrics["late_s"] == math.inf
    assert metrics["arrived_goals"] == 0
    assert metrics["outside_share"] == 1
    assert metrics["final_cm"] == pytest.approx(6.0)


def test_a_deviation_after_arrival_is_the_worst_and_not_the_median():
    track, trajectory = make_arrival(arrives=1.0)
    head = trajectory.head.copy()
    head[np.abs(trajectory.time - 9) < 0.1, 1] += 0.2
    metrics = compute_metrics(track, dataclasses.replace(trajectory, head=head), TOLERANCE)
    assert metrics["after_max_cm"] > 19
    assert metrics["after_median_cm"] == pytest.approx(1.0)
    assert metrics["after_mean_max_cm"] < 5
    assert 0 < metrics["outside_share"] < 0.1


def test_of_several_goals_the_worst_counts():
    time = np.arange(0, 9, DT)
    steps = tuple(GoalStep(1.0 + 4 * i, HOME, 0.0, 1.5) for i in range(2))
    head = hold(HOME, len(time))
    head[time >= 5, 2] -= 0.03
    track = GoalTrack(HOME, 9.0, steps)
    metrics = compute_metrics(track, make_trajectory(time, head, hold(HOME, len(time))), TOLERANCE)
    assert metrics["after_max_cm"] == pytest.approx(3.0)
    first = compute_step_metrics(
        steps[0], 5.0, time, compute_errors(make_trajectory(time, head, hold(HOME, len(time)))),
        TOLERANCE,
    )  # fmt: skip
    assert first["after_max_cm"] == pytest.approx(0.0)


def test_a_moving_goal_is_told_by_its_mean_error():
    time = np.arange(0, 21, DT)
    path = make_curve(HOME)
    goal = np.array([path(float(t)) for t in time])
    head = goal.copy()
    head[:, 2] += 0.07
    track = GoalTrack(HOME, 21.0, path=path)
    metrics = compute_metrics(track, make_trajectory(time, head, goal), TOLERANCE)
    assert metrics["moving_mean_cm"] == pytest.approx(7.0)
    assert metrics["moving_whole_mean_cm"] == pytest.approx(7.0)
    assert metrics["moving_mean_deg"] == pytest.approx(0, abs=1e-5)
    late = goal.copy()
    late[time < LEAD_IN_S + 1, 2] += 1  # over before errors of the moving goal count
    metrics = compute_metrics(track, make_trajectory(time, late, goal), TOLERANCE)
    assert metrics["moving_mean_cm"] == pytest.approx(0)
    assert metrics["moving_whole_mean_cm"] > 4


def test_feet_tilt_falls_and_collisions():
    track, trajectory = make_arrival(arrives=1.0)
    n = len(trajectory.time)
    feet = np.zeros((n, 2, 3))
    feet[n // 2, 1] = [0.03, 0.04, 0]
    base = trajectory.base.copy()
    base[n // 3, 3:] = quat_from_rpy(0.1, 0, 1.0)
    collision = np.zeros(n, dtype=bool)
    collision[-1] = True
    changed = dataclasses.replace(trajectory, feet=feet, base=base, collision=collision)
    metrics = compute_metrics(track, changed, TOLERANCE)
    assert metrics["foot_cm"] == pytest.approx(5.0)
    assert metrics["tilt_deg"] == pytest.approx(math.degrees(0.1))
    assert metrics["collisions"] == metrics["collided_goals"] == 1
    assert metrics["falls"] == 0
    before = np.zeros(n, dtype=bool)
    before[0] = True  # in the lead-in, when no goal was given yet
    metrics = compute_metrics(track, dataclasses.replace(trajectory, collision=before), TOLERANCE)
    assert metrics["collisions"] == 1
    assert metrics["collided_goals"] == 0


def test_a_run_that_ends_in_a_fall_has_no_figures_of_what_did_not_come():
    track, trajectory = make_arrival(arrives=9.0)
    short = {
        each.name: getattr(trajectory, each.name)[:50]
        for each in dataclasses.fields(trajectory)
        if each.name not in ("solve_s", "contacts")
    }
    short["fallen"] = np.arange(50) == 49
    short["hands"] = np.where(short["fallen"][:, None], np.nan, 0.02)  # no goal after the fall
    fallen = Trajectory(**short, solve_s=trajectory.solve_s)
    metrics = compute_metrics(track, fallen, TOLERANCE)
    assert metrics["falls"] == 1
    assert metrics["arrival_s"] == math.inf
    assert math.isnan(metrics["after_max_cm"])
    assert metrics["hand_cm"] == pytest.approx(2)


def test_a_trajectory_checks_its_lengths():
    time = np.arange(3.0)
    with pytest.raises(BadShape, match=r"trajectory.head must have shape \(3, Ellipsis\)"):
        make_trajectory(time, hold(HOME, 2), hold(HOME, 3))


# -- settings ------------------------------------------------------------------------------------


def differing(a, b) -> set[str]:
    return {f.name for f in dataclasses.fields(a) if getattr(a, f.name) != getattr(b, f.name)}


@pytest.mark.parametrize("robot", ["g1", "rby1"])
@pytest.mark.parametrize("name", [name for name in ABLATIONS if name != "default"])
def test_each_ablation_runs_its_own_settings_and_nothing_else_differs(robot, name):
    ablation = ABLATIONS[name]
    stock = TrackingSetup(robot, "squat")
    setup = TrackingSetup(robot, "squat", name)
    own, other = resolve_configs(setup), resolve_configs(stock)
    retargeter = make_retargeter_config(setup, 3)
    changed = differing(retargeter, make_retargeter_config(stock, 3))
    assert changed == set(ablation.retargeter)
    assert (setup.resolved_noise != stock.resolved_noise) == (ablation.noise is not None)
    for mode in Mode:
        fields = differing(own[mode], other[mode])
        if ablation.preset is None:
            # Some may be that of the default already.
            assert fields <= {entry.partition(".")[0] for entry in ablation.mpc}
        else:
            assert {"weighting", "weights", "candidates", "aids"} <= fields
            for entry, value in ablation.mpc.items():
                assert getattr(own[mode], entry) == value
        make = make_tuned_morphology(setup)
        assert make.mpc_config(mode) == own[mode]
    assert setup.compute_key(0) != stock.compute_key(0)


@pytest.mark.parametrize("name", [name for name, each in ABLATIONS.items() if each.mpc])
def test_each_ablation_changes_something_of_some_robot(name):
    def changes(robot: str, mode: Mode) -> bool:
        own = resolve_configs(TrackingSetup(robot, "squat", name))[mode]
        return bool(differing(own, resolve_configs(TrackingSetup(robot, "squat"))[mode]))

    assert any(changes(robot, mode) for robot in ("g1", "rby1") for mode in Mode)


def test_parts_without_a_setting_are_replaced_and_put_back():
    stock = ArmHold.update
    with ABLATIONS["no_hold"].replace():
        assert ArmHold.update is not stock
    assert ArmHold.update is stock
    for ablation in ABLATIONS.values():  # a name that has moved is an error here
        with ablation.replace():
            pass


def test_equal_compute_is_equal_and_the_papers_numbers_are_the_papers():
    for robot in ("g1", "rby1"):
        stock = resolve_configs(TrackingSetup(robot, "squat"))
        equal = resolve_configs(TrackingSetup(robot, "squat", "table1_equal"))
        paper = resolve_configs(TrackingSetup(robot, "squat", "table1"))
        for mode in Mode:
            ratio = compute_policy_steps(equal[mode]) / compute_policy_steps(stock[mode])
            assert ratio == pytest.approx(1, abs=0.03)
            assert paper[mode].num_samples == 30
            assert paper[mode].weighting == "raw"


def test_overrides_of_fields_entries_and_single_modes():
    config = make_morphology("g1").mpc_config(Mode.MOBILE)
    changed = override_config(
        config,
        {"mobile.horizon": 5, "stationary.horizon": 9, "weights.control": 0.5, "noise_std.vx": 0.7},
        Mode.MOBILE,
    )
    assert changed.horizon == 5
    assert changed.weights.control == 0.5
    assert changed.noise_std == {**config.noise_std, "vx": 0.7}
    assert differing(config, changed) == {"horizon", "weights", "noise_std"}


def test_wrong_overrides_are_told():
    config = make_morphology("g1").mpc_config(Mode.MOBILE)
    with pytest.raises(
        UnknownName, match="unknown setting of MpcConfig 'horizont'. Known: .*horizon"
    ):
        override_config(config, {"horizont": 5}, Mode.MOBILE)
    with pytest.raises(UnknownName, match="unknown setting of MpcConfig.weights 'x'"):
        override_config(config, {"weights.x": 5}, Mode.MOBILE)
    with pytest.raises(BadValue, match="setting 'horizon' of MpcConfig has no entries, got 'x'"):
        override_config(config, {"horizon.x": 5}, Mode.MOBILE)
    with pytest.raises(BadValue, match="a setting reads name=value, got 'horizon'"):
        parse_overrides(["horizon"])
    with pytest.raises(UnknownName, match="unknown ablation 'none'. Known: "):
        resolve_configs(TrackingSetup("g1", "squat", "none"))


def test_overrides_are_read_as_yaml():
    read = parse_overrides(
        ["horizon=5", "weights.control=1e-2", "sampling=gaussian", "candidates=[]"]
    )
    assert read["horizon"] == 5
    assert float(read["weights.control"]) == 0.01
    assert read["sampling"] == "gaussian"
    assert read["candidates"] == []


def test_tuning_one_robot_leaves_its_class_alone():
    before = make_morphology("g1").mpc_config(Mode.MOBILE)
    tuned = make_tuned_morphology(TrackingSetup("g1", "squat", overrides={"horizon": 3}))
    assert tuned.mpc_config(Mode.MOBILE).horizon == 3
    assert make_morphology("g1").mpc_config(Mode.MOBILE) == before


def test_the_key_of_a_run_follows_settings_of_setup_and_robot(monkeypatch):
    setup = TrackingSetup("g1", "squat")
    key = setup.compute_key(1)
    assert key.startswith("g1/squat/default/1/")
    assert key == TrackingSetup("g1", "squat").compute_key(1)
    assert key != setup.compute_key(2)
    for other in ({"hold": 3.0}, {"sync": False}, {"noise": "off"}, {"overrides": {"horizon": 2}}):
        assert dataclasses.replace(setup, **other).compute_key(1) != key
    stock = type(make_morphology("g1")).mpc_config
    monkeypatch.setattr(
        type(make_morphology("g1")),
        "mpc_config",
        lambda self, mode: dataclasses.replace(stock(self, mode), reach=9.0),
    )
    assert setup.compute_key(1) != key


def test_the_retargeters_settings_are_the_setups():
    config = make_retargeter_config(TrackingSetup("g1", "squat", sync=False), 7)
    assert config == RetargeterConfig(threads=1, seed=7, sync=False)
    assert make_retargeter_config(TrackingSetup("g1", "squat", "direct"), 0).type == "direct"
