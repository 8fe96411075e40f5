"""Arm inverse kinematics: goals are reached, limits and distances hold, nothing lurches."""

from __future__ import annotations

import mink
import mujoco
import numpy as np
import pytest

from xop_lerobot.core.transforms import (
    make_pose,
    quat_exp,
    quat_from_rpy,
    quat_multiply,
    rotation_error,
)
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.arms.ik import CLEARANCE, ArmIk, Clearance, _find_pairs
from xop_lerobot.retarget.model.kinematics import SiteKinematics

DT = 0.04
MAX_SPEED = 3.0
WRISTS = ("left_wrist", "right_wrist")
robots = pytest.mark.parametrize("name", ["g1", "rby1"])


class Arms:
    """A robot that stands, and the kinematics of its arms."""

    def __init__(self, name: str) -> None:
        self.morphology: Morphology = make_morphology(name)
        self.model = build_model(self.morphology, "full")
        self.joints = [joint for arm in self.morphology.arms for joint in arm.joints]
        self.address = [int(self.model.joint(joint).qposadr[0]) for joint in self.joints]
        limits = self.morphology.arm_limits
        ranges = [limits.get(joint, self.model.joint(joint).range) for joint in self.joints]
        self.range = np.array(ranges)
        self.qpos = self.morphology.standing_qpos()
        self.rest = self.morphology.rest_action().arms[: len(self.joints)]
        sites = tuple(self.morphology.frames[wrist] for wrist in WRISTS)
        self.kinematics = SiteKinematics(self.model, sites)
        self.data = mujoco.MjData(self.model)

    def place(self, arms: np.ndarray, qpos: np.ndarray | None = None) -> np.ndarray:
        q = (self.qpos if qpos is None else qpos).copy()
        q[self.address] = arms
        return q

    def compute_wrists(self, arms: np.ndarray, qpos: np.ndarray | None = None):
        poses = self.kinematics.compute_poses(self.place(arms, qpos))
        return {wrist: poses[self.morphology.frames[wrist]] for wrist in WRISTS}

    def compute_clearance(self, arms: np.ndarray, qpos: np.ndarray | None = None) -> float:
        """Least distance of forearms and hands to the rest of the body [m]."""
        self.data.qpos[:] = self.place(arms, qpos)
        mujoco.mj_kinematics(self.model, self.data)
        return min(
            mujoco.mj_geomDistance(self.model, self.data, a, b, 1.0, None)
            for own, rest in _find_pairs(self.model, self.morphology)
            for a in own
            for b in rest
        )

    def draw_reachable(self, seed: int, share: float = 0.3) -> np.ndarray:
        """Arm angles near rest, within the limits."""
        rng = np.random.default_rng(seed)
        arms = self.rest + share * rng.uniform(-1, 1, len(self.rest))
        return np.clip(arms, self.range[:, 0] + 0.1, self.range[:, 1] - 0.1)


@pytest.fixture(scope="module")
def arms() -> dict[str, Arms]:
    return {name: Arms(name) for name in ("g1", "rby1")}


@pytest.fixture(scope="module")
def solvers(arms) -> dict[str, ArmIk]:
    return {name: ArmIk(each.morphology, MAX_SPEED) for name, each in arms.items()}


def assert_within_limits(a: Arms, before: np.ndarray, after: np.ndarray, dt: float) -> None:
    assert np.isfinite(after).all()
    assert (after >= a.range[:, 0] - 1e-9).all()
    assert (after <= a.range[:, 1] + 1e-9).all()
    assert np.abs(after - before).max() <= MAX_SPEED * dt + 1e-6


# -- reaching ------------------------------------------------------------------------------


@pytest.mark.slow
@robots
@pytest.mark.parametrize("seed", range(4))
def test_a_reachable_goal_is_reached(arms, solvers, name, seed):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(seed))
    angles, wrists, errors = a.rest, {}, []
    for _ in range(75):
        before, angles = angles, ik.solve(a.qpos, angles, goals, DT)
        assert_within_limits(a, before, angles, DT)
        wrists = a.compute_wrists(angles)
        errors.append(max(np.linalg.norm(wrists[w][:3] - goals[w][:3]) for w in WRISTS))
    turns = [np.linalg.norm(rotation_error(goals[w][3:], wrists[w][3:])) for w in WRISTS]
    assert errors[-1] < 0.01
    assert max(turns) < 0.1
    assert errors[10] < errors[0]


@robots
def test_at_the_goal_the_arms_rest(arms, solvers, name):
    """Goals where the hands are at rest move nothing: no drift through the null space."""
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.rest)
    angles = a.rest
    for _ in range(50):
        angles = ik.solve(a.qpos, angles, goals, DT)
    np.testing.assert_allclose(angles, a.rest, atol=0.01)


@robots
def test_the_hands_stay_in_the_world_while_the_body_moves(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.rest)
    angles, qpos = a.rest, a.qpos.copy()
    drop = 0.03 if a.morphology.arm_limits else 0.05  # elbows that may not bend end sooner
    for tick in range(50):
        qpos[2] = a.qpos[2] - drop * np.sin(0.1 * tick)
        qpos[3:7] = quat_from_rpy(0.02 * np.sin(0.2 * tick), 0, 0.1 * np.sin(0.1 * tick))
        angles = ik.solve(qpos, angles, goals, DT)
        wrists = a.compute_wrists(angles, qpos)
        for wrist in WRISTS:
            assert np.linalg.norm(wrists[wrist][:3] - goals[wrist][:3]) < 0.03


@robots
def test_out_of_reach_the_arm_stretches_towards_the_goal(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.rest)
    for goal in goals.values():
        goal[0] += 3.0
    angles, reaches = a.rest, []
    for _ in range(100):
        before, angles = angles, ik.solve(a.qpos, angles, goals, DT)
        assert_within_limits(a, before, angles, DT)
        reaches.append(a.compute_wrists(angles)["left_wrist"][0])
    start = a.compute_wrists(a.rest)["left_wrist"][0]
    assert reaches[-1] > start + 0.15
    assert np.ptp(reaches[-20:]) < 0.01  # it has come to rest there


# -- limits --------------------------------------------------------------------------------


@robots
def test_wild_goals_never_break_a_limit(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    rng = np.random.default_rng(0)
    angles = a.rest
    for _ in range(60):
        goals = {
            wrist: make_pose(rng.uniform(-2, 2, 3), quat_exp(rng.normal(size=3)))
            for wrist in WRISTS
        }
        dt = float(rng.choice([0.02, 0.04, 0.05]))
        before, angles = angles, ik.solve(a.qpos, angles, goals, dt)
        assert_within_limits(a, before, angles, dt)


@robots
def test_a_stall_moves_the_arms_no_further_than_a_late_tick(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(1, 0.8))
    late, stalled = (ik.solve(a.qpos, a.rest, goals, dt) for dt in (0.05, 1.0))
    np.testing.assert_array_equal(late, stalled)
    assert np.abs(late - a.rest).max() > 0.01


@robots
def test_a_jump_of_the_goal_is_no_lurch(arms, solvers, name):
    """A tracking glitch of 0.5 m for one tick moves the joints by one tick's speed at most."""
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.rest)
    jumped = {wrist: pose + [0.3, 0, 0.4, 0, 0, 0, 0] for wrist, pose in goals.items()}
    angles = ik.solve(a.qpos, a.rest, jumped, DT)
    assert_within_limits(a, a.rest, angles, DT)
    for _ in range(40):
        angles = ik.solve(a.qpos, angles, goals, DT)
    np.testing.assert_allclose(angles, a.rest, atol=0.05)


@robots
def test_targets_out_of_their_limits_come_back(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    angles = ik.solve(a.qpos, a.range[:, 1] + 0.3, a.compute_wrists(a.rest), DT)
    assert (angles <= a.range[:, 1] + 1e-9).all()


# -- the body ------------------------------------------------------------------------------


@robots
@pytest.mark.parametrize("depth", [0.0, -0.1])
def test_a_goal_inside_the_body_is_not_followed_into_it(arms, solvers, name, depth):
    a, ik = arms[name], solvers[name]
    head = SiteKinematics(a.model, ("head",)).compute_poses(a.qpos)["head"][:3]
    goals = a.compute_wrists(a.rest)
    for goal in goals.values():
        goal[:3] = head + [depth, 0, -0.35]
    angles, clearances = a.rest, []
    for _ in range(60):
        before, angles = angles, ik.solve(a.qpos, angles, goals, DT)
        assert_within_limits(a, before, angles, DT)
        clearances.append(a.compute_clearance(angles))
    # The distance of 25 mm is held to first order in each step only.
    assert min(clearances) > 0.5 * CLEARANCE
    assert np.median(clearances) > 0.9 * CLEARANCE
    moved = a.compute_wrists(angles)["left_wrist"][1] - a.compute_wrists(a.rest)["left_wrist"][1]
    assert moved < -0.03  # it does go there


@robots
def test_the_bound_is_of_the_distances_that_are_left(arms, name):
    """By central differences of the distances; pairs that are far apart are not bounded."""
    a = arms[name]
    limit = Clearance(a.model, _find_pairs(a.model, a.morphology))
    configuration, rng = mink.Configuration(a.model), np.random.default_rng(1)

    def measure(qpos: np.ndarray) -> np.ndarray:
        a.data.qpos[:] = qpos
        mujoco.mj_kinematics(a.model, a.data)
        return np.array(
            [mujoco.mj_geomDistance(a.model, a.data, *pair, 1.0, None) for pair in pairs]
        )

    pairs, near, far = limit.geom_id_pairs, 0, 0
    for _ in range(6):
        qpos = a.place(a.rest + 0.8 * rng.uniform(-1, 1, len(a.rest)))
        configuration.update(qpos)
        matrix, bound = limit.compute_qp_inequalities(configuration, 0.02)
        assert matrix is not None
        assert bound is not None
        distance = measure(qpos)
        step = np.zeros(a.model.nv)
        step[[int(a.model.joint(joint).dofadr[0]) for joint in a.joints]] = rng.normal(
            size=len(a.joints)
        )
        shifted = []
        for sign in (1, -1):
            moved = qpos.copy()
            mujoco.mj_integratePos(a.model, moved, step, sign * 1e-5)
            shifted.append(measure(moved))
        change = (shifted[0] - shifted[1]) / 2e-5
        seen = distance < 0.1
        expected = np.maximum((distance - CLEARANCE) / 0.1, -0.5) * 0.02
        np.testing.assert_allclose(bound[seen], expected[seen], atol=1e-9)
        assert np.isinf(bound[~seen]).all()
        # Boxes have edges, where the nearest point jumps: nearly all pairs are compared.
        agrees = np.abs(-matrix[seen] @ step - change[seen]) < 1e-3
        assert agrees.mean() > 0.8
        near, far = near + int(seen.sum()), far + int((~seen).sum())
    assert near > 20
    assert far > 20


def test_arms_give_way_to_a_torso_that_turns(arms, solvers):
    """The hands stay where they are, and the chest turns over the belly at 1.2 rad/s."""
    a, ik = arms["rby1"], solvers["rby1"]
    goals, angles, clearances = a.compute_wrists(a.rest), a.rest, []
    qpos, turn = a.qpos.copy(), int(a.model.joint("torso_5").qposadr[0])
    for i in range(50):
        qpos[turn] = min(1.2 * i * DT, 1.6)
        before, angles = angles, ik.solve(qpos, angles, goals, DT)
        assert_within_limits(a, before, angles, DT)
        clearances.append(a.compute_clearance(angles, qpos))
    assert min(clearances) > 0.5 * CLEARANCE
    assert ik.failures == 0


@robots
def test_pairs_leave_neighbours_out(arms, name):
    """No pair holds two geoms of one arm's own chain, and every pair is named once."""
    a = arms[name]
    seen = set()
    for (own, rest), arm in zip(_find_pairs(a.model, a.morphology), a.morphology.arms, strict=True):
        root = int(a.model.joint(arm.joints[0]).bodyid[0])
        assert own
        assert rest
        for geom in rest:
            body = int(a.model.geom_bodyid[geom])
            while body:
                assert body != root
                body = int(a.model.body_parentid[body])
        pairs = {frozenset((x, y)) for x in own for y in rest}
        assert not pairs & seen
        seen |= pairs


# -- what it is given ----------------------------------------------------------------------


@robots
def test_a_frozen_joint_measured_beyond_its_limit_still_solves(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    qpos, failures = a.qpos.copy(), ik.failures
    joint = a.model.joint("left_knee_joint" if name == "g1" else "torso_1")
    qpos[joint.qposadr[0]] = joint.range[1] + 0.05
    goals = a.compute_wrists(a.rest)
    goals["left_wrist"][2] += 0.1
    angles = ik.solve(qpos, a.rest, goals, DT)
    assert ik.failures == failures
    assert np.abs(angles - a.rest).max() > 1e-3


@robots
def test_measured_arm_angles_do_not_matter(arms, solvers, name):
    """It works on the targets: noise and sag of the arms never come back into them."""
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(2))
    sagging = a.place(a.rest - 0.1)
    np.testing.assert_array_equal(
        ik.solve(a.qpos, a.rest, goals, DT), ik.solve(sagging, a.rest, goals, DT)
    )


@robots
def test_it_remembers_nothing(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(3))
    first = ik.solve(a.qpos, a.rest, goals, DT)
    ik.solve(a.qpos, a.draw_reachable(4), a.compute_wrists(a.rest), DT)
    np.testing.assert_array_equal(ik.solve(a.qpos, a.rest, goals, DT), first)


@robots
def test_without_goals_the_arms_stay(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    got = ik.solve(a.qpos, a.rest, {}, DT)
    np.testing.assert_array_equal(got, a.rest)
    got[0] += 1  # a copy
    assert a.rest[0] != got[0]


@robots
def test_an_arm_without_a_goal_stays(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    angles = a.draw_reachable(5)
    goals = {"left_wrist": a.compute_wrists(angles)["left_wrist"]}
    goals["left_wrist"][2] += 0.1
    got, half = angles, len(angles) // 2
    for _ in range(20):
        got = ik.solve(a.qpos, got, goals, DT)
    np.testing.assert_array_equal(got[half:], angles[half:])
    assert np.abs(got[:half] - angles[:half]).max() > 0.05
    both = ik.solve(a.qpos, got, a.compute_wrists(a.rest), DT)  # and then it is free again
    assert np.abs(both[half:] - angles[half:]).max() > 1e-3


@robots
def test_no_time_no_motion(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(6))
    np.testing.assert_array_equal(ik.solve(a.qpos, a.rest, goals, 0.0), a.rest)


@robots
def test_inputs_are_left_untouched(arms, solvers, name):
    a, ik = arms[name], solvers[name]
    goals = a.compute_wrists(a.draw_reachable(7))
    turn = quat_exp(np.array([0.1, 0, 0]))
    goals["left_wrist"][3:] = quat_multiply(turn, goals["left_wrist"][3:])
    frozen = [a.qpos.copy(), a.rest.copy(), *(goal.copy() for goal in goals.values())]
    ik.solve(a.qpos, a.rest, goals, DT)
    for now, before in zip([a.qpos, a.rest, *goals.values()], frozen, strict=True):
        np.testing.assert_array_equal(now, before)
