"""Cost terms: each against a slow reference with plain loops, and on cases made by hand."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    heading_error,
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.morphology.contacts import Feet, Wheels
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.recording.columns import COST_NAMES
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.costs import (
    COSTS,
    CollisionCost,
    ControlCost,
    Evaluation,
    FallCost,
    LateralCost,
    StanceCost,
    SupportArea,
    SupportCost,
    TerminalCost,
    TrackingCost,
    UprightCost,
)
from xop_lerobot.retarget.costs.balance import compute_facing
from xop_lerobot.retarget.obstacles import Obstacle
from xop_lerobot.retarget.presets import build_configs

K, H, NQ, NV, NA = 5, 4, 9, 8, 3
SITES = ("a", "b", "c")
WEIGHTS = CostWeights(position=1.3, orientation=0.4, tilt_share=0.3, lateral=0.2)
DT = 0.02
SHAPING = ("collision_decay", "collision_velocity_decay", "collision_range")
SQUARE = ((0.3, -0.2), (0.3, 0.2), (-0.3, 0.2), (-0.3, -0.2))


def draw_poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return make_pose(rng.normal(size=(*shape, 3)), quat_exp(rng.normal(size=(*shape, 3))))


def make_evaluation(seed: int = 0, **fields) -> Evaluation:
    """A batch of random predictions."""
    rng = np.random.default_rng(seed)
    qpos, terminal_qpos = rng.normal(size=(K, H + 1, NQ)), rng.normal(size=(K, NQ))
    qpos[..., :7], terminal_qpos[:, :7] = draw_poses(rng, K, H + 1), draw_poses(rng, K)
    values = {
        "qpos": qpos,
        "qvel": rng.normal(size=(K, H + 1, NV)),
        "commands": rng.normal(size=(K, H, NA)),
        "executed": rng.normal(size=NA),
        "reference": rng.normal(size=NA),
        "poses": {name: draw_poses(rng, K, H + 1) for name in ("head", "left_wrist")},
        "points": {site: rng.normal(size=(K, H + 1, 3)) for site in SITES},
        "velocities": {site: rng.normal(size=(K, H + 1, 3)) for site in SITES},
        "terminal_points": {site: rng.normal(size=(K, 3)) for site in SITES},
        "terminal_qpos": terminal_qpos,
        "terminal_com": rng.normal(size=(K, 3)),
        "goals": {name: draw_poses(rng, H + 1) for name in ("head", "left_wrist")},
        "terminal_poses": {name: draw_poses(rng, K) for name in ("head", "left_wrist")},
        "terminal_goals": {name: draw_poses(rng) for name in ("head", "left_wrist")},
        "facing": np.array([0.3, -0.2]),
        "mode": Mode.STATIONARY,
        "dt": DT,
        "weights": WEIGHTS,
        "upright": ("left_wrist",),
        "drives": True,
        "balance": None,
        "extrapolates": True,
        "scale_control": True,
    }
    names = {field.name for field in dataclasses.fields(Evaluation)}
    return Evaluation(**{name: (values | fields)[name] for name in names})


# -- tracking and terminal -----------------------------------------------------------------


def compute_pose_cost(pose: np.ndarray, goal: np.ndarray, w: CostWeights) -> float:
    position = sum((pose[i] - goal[i]) ** 2 for i in range(3))
    x, y, z = heading_error(goal[3:], pose[3:])
    return w.position * position + w.orientation * (z * z + w.tilt_share * (x * x + y * y))


def test_tracking_equals_its_formula():
    e = make_evaluation()
    expected = [
        sum(
            compute_pose_cost(e.poses[name][i, k], e.goals[name][k], WEIGHTS)
            for name in e.goals
            for k in range(1, H + 1)
        )
        / H
        for i in range(K)
    ]
    np.testing.assert_allclose(TrackingCost().compute(e), expected)


def test_terminal_equals_its_formula():
    e = make_evaluation()
    expected = [
        WEIGHTS.terminal
        * sum(
            compute_pose_cost(e.terminal_poses[name][i], e.terminal_goals[name], WEIGHTS)
            for name in e.terminal_goals
        )
        for i in range(K)
    ]
    np.testing.assert_allclose(TerminalCost().compute(e), expected)


def test_tracking_by_hand():
    """0.1 m off in position all along costs 0.01; the start, which nothing can change, nothing."""
    goal = make_pose(np.array([1.0, 0, 1.2]), quat_from_yaw(0.3))
    poses = np.tile(goal, (1, H + 1, 1))
    poses[:, 1:, 1] += 0.1
    poses[:, 0, :3] += 100
    e = make_evaluation(
        poses={"head": poses}, goals={"head": np.tile(goal, (H + 1, 1))}, weights=CostWeights()
    )
    e = dataclasses.replace(e, qpos=e.qpos[:1])
    np.testing.assert_allclose(TrackingCost().compute(e), [0.01])


@pytest.mark.parametrize("axis, share", [(0, 0.3), (1, 0.3), (2, 1.0)])
def test_a_tilt_counts_less_than_a_turn(axis, share):
    goal = make_pose(np.array([0, 0, 1]), quat_from_yaw(0.8))
    turn = quat_exp(0.2 * np.eye(3)[axis])
    pose = make_pose(np.array([0, 0, 1]), quat_multiply(goal[3:], turn))
    e = make_evaluation(terminal_poses={"head": pose[None]}, terminal_goals={"head": goal})
    e = dataclasses.replace(e, qpos=e.qpos[:1])
    expected = WEIGHTS.terminal * WEIGHTS.orientation * share * 0.2**2
    np.testing.assert_allclose(TerminalCost().compute(e), [expected])


def test_without_goals_tracking_is_free():
    e = make_evaluation(goals={}, terminal_goals={})
    np.testing.assert_array_equal(TrackingCost().compute(e), np.zeros(K))
    np.testing.assert_array_equal(TerminalCost().compute(e), np.zeros(K))


# -- stance --------------------------------------------------------------------------------


def compute_stance_slowly(e: Evaluation, groups: tuple[tuple[str, ...], ...]) -> list[float]:
    totals = []
    for i in range(K):
        total = 0.0
        for k in range(1, H + 1):
            speeds, heights = [], []
            for group in groups:
                squares = [sum(e.velocities[s][i, k, j] ** 2 for j in range(3)) for s in group]
                speeds.append(sum(squares) / len(group))
                heights.append(sum(e.points[s][i, k, 2] for s in group) / len(group))
            if e.mode is Mode.STATIONARY:
                total += sum(speeds)
            else:
                total += speeds[heights.index(min(heights))]
        totals.append(WEIGHTS.stance * total / H)
    return totals


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize(
    "groups",
    [
        (("a",), ("b",)),
        (("a", "b"), ("b", "c")),
        (("a", "b", "c"),),
        (("a", "b"), ("c",)),
    ],
)
def test_stance_equals_its_formula(mode, groups):
    e = make_evaluation(mode=mode)
    cost = StanceCost(groups, Feet()).compute(e)
    np.testing.assert_allclose(cost, compute_stance_slowly(e, groups))


def test_in_mobile_mode_the_swinging_foot_is_free():
    still = np.zeros((1, H + 1, 3))
    swinging = still.copy()
    swinging[..., 0] = 1.0  # m/s
    points = {"a": still, "b": still + np.array([0, 0, 0.05])}
    velocities = {"a": still, "b": swinging}
    e = make_evaluation(points=points, velocities=velocities, mode=Mode.MOBILE)
    cost = StanceCost((("a",), ("b",)), Feet())
    np.testing.assert_array_equal(cost.compute(e), [0])
    standing = dataclasses.replace(e, mode=Mode.STATIONARY)
    np.testing.assert_allclose(cost.compute(standing), [WEIGHTS.stance])


def test_wheels_may_roll_in_mobile_mode_only():
    cost = StanceCost((("a",), ("b",)), Wheels())
    np.testing.assert_array_equal(cost.compute(make_evaluation(mode=Mode.MOBILE)), np.zeros(K))
    assert (cost.compute(make_evaluation(mode=Mode.STATIONARY)) > 0).all()


# -- control -------------------------------------------------------------------------------


def test_control_equals_its_formula():
    e, scale = make_evaluation(), np.array([0.1, 1.0, 2.0])
    expected = [
        WEIGHTS.control
        * sum(
            ((e.commands[i, k, j] - e.reference[j]) / scale[j]) ** 2
            for k in range(H)
            for j in range(NA)
        )
        / H
        for i in range(K)
    ]
    np.testing.assert_allclose(ControlCost(scale).compute(e), expected)


def test_control_in_the_entries_own_units_is_the_papers_energy():
    e = make_evaluation(scale_control=False, reference=np.zeros(NA))
    expected = WEIGHTS.control * np.square(np.linalg.norm(e.commands, axis=2)).mean(axis=1)
    np.testing.assert_allclose(ControlCost(np.array([0.1, 1.0, 2.0])).compute(e), expected)


def test_the_reference_costs_nothing():
    e = make_evaluation(commands=np.tile([0.75, 0.3, 0.1], (K, H, 1)), reference=[0.75, 0.3, 0.1])
    np.testing.assert_array_equal(ControlCost(np.ones(NA)).compute(e), np.zeros(K))


# -- support -------------------------------------------------------------------------------


def base_at(x: float, y: float, yaw: float) -> np.ndarray:
    return make_pose(np.array([x, y, 0.4]), quat_from_yaw(yaw))


@pytest.mark.parametrize(
    "point, excess",
    [
        ((0, 0), (0, 0, 0, 0)),
        ((0.2, 0.1), (0, 0, 0, 0)),
        ((0.3, 0), (0.05, 0, 0, 0)),
        ((0, -0.25), (0, 0, 0, 0.1)),
        ((-0.35, 0.3), (0, 0.15, 0.1, 0)),
    ],
)
@pytest.mark.parametrize("base", [(0, 0, 0), (2, -1, 0.7), (0, 0, -2.5)])
def test_excess_over_each_edge_by_hand(point, excess, base):
    """Edges in the order of the corners: front, left, back, right; shrunk by 5 cm."""
    pose = base_at(*base)
    world = pose[:2] + quat_rotate(pose[3:], np.array([*point, 0]))[:2]
    got = SupportArea(SQUARE, margin=0.05).compute_excess(pose, world)
    np.testing.assert_allclose(got, excess, atol=1e-12)


def test_excess_does_not_change_when_the_base_tilts_forward():
    """Only place and heading of the base count: the area lies on the ground."""
    tilted = make_pose(np.array([1, 2, 0.4]), quat_from_rpy(0.0, 0.3, 0.5))
    level = make_pose(np.array([1, 2, 0.4]), quat_from_yaw(0.5))
    area, point = SupportArea(SQUARE), np.array([1.5, 2.1])
    np.testing.assert_allclose(
        area.compute_excess(tilted, point), area.compute_excess(level, point)
    )


def test_support_equals_its_formula():
    area, e = SupportArea(SQUARE, margin=0.05), make_evaluation()
    expected = [
        WEIGHTS.support * sum(area.compute_excess(qpos[:7], com[:2]) ** 2)
        for qpos, com in zip(e.terminal_qpos, e.terminal_com, strict=True)
    ]
    np.testing.assert_allclose(SupportCost(area).compute(e), expected)


@pytest.mark.parametrize("base", [(0, 0, 0), (2, -1, 0.7)])
def test_a_lean_counts_from_where_the_robot_rests(base):
    """The centre of mass 0.2 m ahead of its place of rest, in the heading of the base."""
    pose = base_at(*base)
    com = pose[:3] + quat_rotate(pose[3:], np.array([0.25, 0.0, 0.6]))
    e = make_evaluation(
        qpos=np.tile(pose, (1, H + 1, 1)),
        terminal_com=com[None],
        terminal_qpos=pose[None],
        weights=CostWeights(lean=3.0),
    )
    corners = ((1, -1), (1, 1), (-1, 1), (-1, -1))
    area = SupportArea(corners, resting=(0.05, 0.0), free=0.0)
    np.testing.assert_allclose(SupportCost(area).compute(e), [3.0 * 0.2**2])
    area = SupportArea(corners, resting=(0.05, 0.0), free=0.05)
    np.testing.assert_allclose(SupportCost(area).compute(e), [3.0 * 0.15**2])
    area = SupportArea(corners, resting=(0.05, 0.0), free=0.3)
    np.testing.assert_array_equal(SupportCost(area).compute(e), [0])


def test_a_robot_that_balances_itself_has_no_support_cost():
    np.testing.assert_array_equal(SupportCost(None).compute(make_evaluation()), np.zeros(K))


# -- fall ----------------------------------------------------------------------------------


def evaluate_fall(pose: np.ndarray) -> float:
    e = make_evaluation(qpos=np.tile(pose, (1, H + 1, 1)), weights=CostWeights(fall=10.0))
    return FallCost(tilt=0.8, height=0.35, standing_height=0.75).compute(e)[0]


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_fall_counts_tilt_beyond_half_the_limit(yaw):
    for roll, pitch in ((0, 0), (0.39, 0), (0, -0.39)):
        quat = quat_multiply(quat_from_yaw(yaw), quat_from_rpy(roll, pitch, 0))
        assert evaluate_fall(make_pose(np.array([0, 0, 0.75]), quat)) == 0
    quat = quat_multiply(quat_from_yaw(yaw), quat_from_rpy(0, 0.6, 0))
    assert evaluate_fall(make_pose(np.array([0, 0, 0.75]), quat)) == pytest.approx(10 * 0.2**2)


def test_fall_counts_height_under_the_last_quarter():
    upright = np.array([1.0, 0, 0, 0])
    assert evaluate_fall(make_pose(np.array([0, 0, 0.46]), upright)) == 0
    assert evaluate_fall(make_pose(np.array([0, 0, 0.35]), upright)) == pytest.approx(10 * 0.1**2)


def test_fall_does_not_count_what_a_robot_that_squats_does():
    """It rests low, and leans as its policy does under the executed command."""
    cost = FallCost(0.8, 0.35, 0.75, lowest=0.42, compute_rest_tilt=lambda _command, _mode: 0.5)
    for height, pitch, excess in ((0.42, 0.5, 0.0), (0.42, 0.7, 0.05), (0.37, 0.5, 0.015)):
        pose = make_pose(np.array([0, 0, height]), quat_from_rpy(0, pitch, 0))
        e = make_evaluation(qpos=np.tile(pose, (1, H + 1, 1)), weights=CostWeights(fall=10.0))
        assert cost.compute(e)[0] == pytest.approx(10 * excess**2)


def test_fall_does_not_count_the_start():
    upright = np.array([0, 0, 0.75, 1, 0, 0, 0])
    e = make_evaluation(qpos=np.tile(upright, (1, H + 1, 1)))
    e.qpos[:, 0, 2] = -5
    np.testing.assert_array_equal(FallCost(0.8, 0.35, 0.75).compute(e), [0])


# -- all of them ---------------------------------------------------------------------------

BOX = Obstacle(
    "box", np.array([0.5, -0.2, 0.4]), quat_from_rpy(0.2, 0.4, 0.9), np.array([0.3, 0.1, 0.2])
)
ALL = (
    TrackingCost(),
    TerminalCost(),
    StanceCost((("a",), ("b",)), Feet()),
    CollisionCost((BOX,), {"a": 0.1}),
    ControlCost(np.ones(NA)),
    SupportCost(SupportArea(SQUARE)),
    LateralCost(nonholonomic=True),
    FallCost(0.8, 0.35, 0.75),
    UprightCost(),
)


@pytest.mark.parametrize("cost", ALL, ids=lambda cost: cost.name)
def test_costs_are_finite_positive_and_proportional_to_their_weight(cost):
    value = cost.compute(make_evaluation())
    assert value.shape == (K,)
    assert (value >= 0).all()
    assert (value > 0).any()
    doubled = {f.name: 2 * getattr(WEIGHTS, f.name) for f in dataclasses.fields(CostWeights)}
    # These are factors on other weights, or shape what is weighted.
    names = ("tilt_share", "terminal", *SHAPING)
    keep = {name: getattr(WEIGHTS, name) for name in names}
    weights = CostWeights(**(doubled | keep))
    np.testing.assert_allclose(cost.compute(make_evaluation(weights=weights)), 2 * value)
    nothing = CostWeights(**{name: 0.0 for name in doubled})
    np.testing.assert_array_equal(cost.compute(make_evaluation(weights=nothing)), np.zeros(K))


def test_the_costs_of_table1_are_the_papers_by_the_letter():
    r"""H times their total is :math:`\sum_k l(x_k, a_k) + V_f(x_H)` of Eqs. 1a and 3."""
    morphology = make_morphology("rby1")
    settings = RetargeterConfig(preset="table1", num_samples=K)
    config = build_configs(morphology, settings)[Mode.STATIONARY]
    w = dataclasses.replace(config.weights, terminal=1.0 / H)  # H of this batch, not Table I's
    e = make_evaluation(
        weights=w, reference=np.zeros(NA), upright=(),
        scale_control=config.scale_control, extrapolates=config.extrapolation_s > 0,
    )  # fmt: skip
    last = {name: poses[:, -1] for name, poses in e.poses.items()}
    ends = {name: goals[-1] for name, goals in e.goals.items()}
    e = dataclasses.replace(e, terminal_poses=last, terminal_goals=ends)
    distances = CollisionCost((BOX,), {"a": 0.1}).obstacles.compute_distances

    def track(i: int, k: int) -> float:
        return sum(compute_pose_cost(e.poses[n][i, k], e.goals[n][k], w) for n in e.goals)

    def run(i: int, k: int) -> float:
        gap = float(distances(e.points["a"][i, k][None])[0, 0]) - 0.1
        speed = np.square(e.qvel[i, k, :2]).sum()
        moved = sum(np.square(e.velocities[site][i, k]).sum() for site in ("a", "b"))
        energy = np.square(e.commands[i, k - 1]).sum()
        collision = math.exp(-1.0 * gap) + speed * math.exp(-10.0 * gap)
        return track(i, k) + 0.1 * moved + collision + 0.1 * energy

    expected = [sum(run(i, k) for k in range(1, H + 1)) + track(i, H) for i in range(K)]
    total = sum(cost.compute(e) for cost in ALL)
    np.testing.assert_allclose(H * total, expected, rtol=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_lateral_is_the_angle_to_where_the_base_shall_face(share):
    turned = np.tile(base_at(1, 2, np.pi / 2), (K, 1))
    e = make_evaluation(
        terminal_qpos=np.concatenate([turned, np.zeros((K, NQ - 7))], 1),
        facing=share * np.array([math.cos(0.3), math.sin(0.3)]),
        weights=CostWeights(lateral=2.0),
    )
    expected = 2.0 * share**2 * (np.pi / 2 - 0.3) ** 2
    np.testing.assert_allclose(LateralCost(nonholonomic=True).compute(e), expected)
    anywhere = dataclasses.replace(e, facing=np.zeros(2))
    np.testing.assert_array_equal(LateralCost(nonholonomic=True).compute(anywhere), 0)
    np.testing.assert_array_equal(LateralCost(nonholonomic=False).compute(e), 0)


@pytest.mark.parametrize(
    "heading, velocity, look, facing",
    [
        (0.0, [1.0, 0.0], 0.0, 0.0),  # ahead
        (0.0, [-1.0, 0.0], 0.0, 0.0),  # behind: it backs up, and does not turn round
        (0.1, [0.0, 10.0], 0.0, 1.56),  # far to the left: it turns there
        (-1.2, [0.0, 10.0], 0.0, -1.56),  # facing away already: it backs up there
        (-0.5, [-2.3, 9.7], 1.8, 1.8),  # the same, but no waist twists that far: it turns round
        (0.0, [0.0, 0.1], 0.0, math.pi / 4),  # near the line, it closes in on it
        (0.0, [0.0, 0.0], 0.4, 0.4),  # there: it faces as the goal looks
    ],
)
def test_where_a_base_on_wheels_shall_face(heading, velocity, look, facing):
    x, y = compute_facing(heading, np.array(velocity), look, speed=1.0, max_twist=1.9)
    assert math.atan2(y, x) == pytest.approx(facing, abs=0.01)
    assert math.hypot(x, y) == pytest.approx(1)
    # All of it turns with the world.
    turned = quat_rotate(quat_from_yaw(0.5), np.array([*velocity, 0.0]))[:2]
    x, y = compute_facing(heading + 0.5, turned, look + 0.5, speed=1.0, max_twist=1.9)
    assert math.atan2(y, x) == pytest.approx(facing + 0.5, abs=0.01)


def test_the_last_centimetres_are_left_to_the_waist():
    lengths = [
        np.hypot(*compute_facing(0.0, np.array([0.3, 0.3]), 0.0, speed, 1.9))
        for speed in (0.0, 0.08, 0.14, 0.2, 2.0)
    ]
    np.testing.assert_allclose(lengths, [0, 0, 0.5, 1, 1])


def test_every_term_has_its_own_name():
    assert len({cost.name for cost in ALL}) == len(ALL)


@pytest.mark.parametrize("cost", ALL, ids=lambda cost: cost.name)
def test_a_sample_costs_the_same_alone(cost):
    """No term may mix samples."""
    e = make_evaluation()
    alone = dataclasses.replace(
        e,
        **{
            name: getattr(e, name)[2:3]
            for name in ("qpos", "qvel", "commands", "terminal_qpos", "terminal_com")
        },
        **{
            name: {key: value[2:3] for key, value in getattr(e, name).items()}
            for name in ("poses", "points", "velocities", "terminal_points", "terminal_poses")
        },
    )
    np.testing.assert_allclose(cost.compute(alone), cost.compute(e)[2:3])


# -- the documentation ---------------------------------------------------------------------


def test_the_documented_defaults_are_the_real_ones():
    """Table of the terms in the retargeter's page: `name` in the fourth column from the end."""
    text = (Path(__file__).parents[2] / "docs" / "how_it_works" / "retargeter.md").read_text()
    documented = {}
    for row in text.splitlines():
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if row.startswith("|") and len(cells) == 6 and cells[2].startswith("`"):
            documented[cells[2].split("`")[1]] = float(cells[4])
    defaults = CostWeights()
    actual = {f.name: getattr(defaults, f.name) for f in dataclasses.fields(CostWeights)}
    used = {name for name, value in actual.items() if value}
    assert used <= set(documented), "retargeter.md lacks a weight of CostWeights"
    assert documented.items() <= actual.items(), "retargeter.md is behind CostWeights"


def test_datasets_list_the_terms_in_an_order_that_stays():
    names = [cost.name for cost in COSTS]
    first = ["tracking", "stance", "collision", "upright", "control", "change", "terminal"]
    assert names[: len(first) + 3] == [*first, "support", "lateral", "fall"]
    assert (*names, "total") == COST_NAMES
