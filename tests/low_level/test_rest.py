"""How a standing robot leans and moves its base unasked: the map, the planner's use of it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from benchmarks.low_level_comparison import make_simulation, measure_rest
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import compute_projected_gravity, quat_exp, quat_from_yaw
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.rest import RestMap
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.model.command_model import CommandModel, Start

HEIGHTS, PITCHES = [0.4, 0.5, 0.6, 0.8], [-0.5, 0.0, 0.4]
HEIGHT, PITCH = 0, 3
"""Entries of G1's command."""
DT = 0.4


def make_map(rng: np.random.Generator, held: tuple[str, ...] = ()) -> RestMap:
    shape = (len(HEIGHTS), len(PITCHES))
    pitch, forward = rng.uniform(-0.5, 0.5, (2, *shape))
    axes = {"height": HEIGHTS, "waist_pitch": PITCHES}
    return RestMap(axes, pitch.tolist(), forward.tolist(), held)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(make_morphology("g1"), "planning")


def make_command_model(model: mujoco.MjModel, rest: RestMap | None) -> CommandModel:
    morphology = make_morphology("g1")
    return CommandModel(model, morphology.command_space, morphology.effects, rest=rest)


# -- the map ---------------------------------------------------------------------------------


def test_it_is_bilinear_and_stays_as_at_its_edge():
    """Slow twin: SciPy's interpolation of the clipped values."""
    rng = np.random.default_rng(0)
    rest = make_map(rng)
    first, second = rng.uniform(0.3, 0.9, (5, 40)), rng.uniform(-0.7, 0.6, (5, 40))
    clipped = np.stack([np.clip(first, 0.4, 0.8), np.clip(second, -0.5, 0.4)], axis=-1)
    got = rest(first, second)
    for values, one in zip(rest._values, (got.pitch, got.forward), strict=True):
        expected = RegularGridInterpolator((HEIGHTS, PITCHES), values)(clipped)
        np.testing.assert_allclose(one, expected, atol=1e-12)


def test_its_slopes_equal_finite_differences():
    rng = np.random.default_rng(1)
    rest = make_map(rng)
    first, second, step = rng.uniform(0.3, 0.9, 200), rng.uniform(-0.7, 0.6, 200), 1e-6
    got = rest(first, second)
    for entry, (da, db) in enumerate(((step, 0.0), (0.0, step))):
        ahead, behind = rest(first + da, second + db), rest(first - da, second - db)
        pitch = (ahead.pitch - behind.pitch) / (2 * step)
        forward = (ahead.forward - behind.forward) / (2 * step)
        np.testing.assert_allclose(got.pitch_slope[..., entry], pitch, atol=1e-6)
        np.testing.assert_allclose(got.forward_slope[..., entry], forward, atol=1e-6)


@pytest.mark.parametrize(
    ("axes", "rows", "message"),
    [
        ({"height": [0.4, 0.5]}, 2, "rest needs two entries of the command, got height"),
        (
            {"height": [0.5, 0.4], "waist_pitch": [0, 1]},
            2,
            "rest: values of height must increase, got [0.5, 0.4]",
        ),
        (
            {"height": [0.4, 0.5], "waist_pitch": [0, 1]},
            3,
            "rest: pitch must have 2 rows of 2 numbers",
        ),
    ],
)
def test_what_does_not_fit_is_named(axes, rows, message):
    table = [[0.0, 0.0]] * rows
    with pytest.raises(BadValue) as error:
        RestMap(axes, table, table)
    assert str(error.value) == message


# -- the planner's model -----------------------------------------------------------------------


def test_the_base_goes_to_where_it_rests(model):
    """From the rest under one command to that under another, in the robot's heading."""
    rest = make_map(np.random.default_rng(2))
    command_model = make_command_model(model, rest)
    settled = make_morphology("g1").command_space.neutral.copy()
    command = settled.copy()
    command[[HEIGHT, PITCH]] = 0.55, -0.2
    both = np.stack([settled, command])
    rests = rest(both[:, HEIGHT], both[:, PITCH])
    (forward,), (pitch,) = np.diff(rests.forward), np.diff(rests.pitch)
    qpos = make_morphology("g1").standing_qpos()
    qpos[3:7] = quat_from_yaw(np.pi / 2)
    got = command_model.extrapolate(Start(qpos, settled=settled), command, 60.0, Mode.STATIONARY)
    np.testing.assert_allclose(got[:2], [0, forward], atol=1e-9)
    gravity = compute_projected_gravity(got[None, 3:7])[0]
    np.testing.assert_allclose(gravity[:2], [np.sin(pitch), 0], atol=1e-9)
    stays = command_model.extrapolate(Start(qpos, settled=settled), settled, 60.0, Mode.STATIONARY)
    np.testing.assert_allclose(stays[3:7], qpos[3:7], atol=1e-12)
    walks = command_model.extrapolate(Start(qpos, settled=settled), command, 60.0, Mode.MOBILE)
    np.testing.assert_allclose(walks[3:7], qpos[3:7], atol=1e-12)


@pytest.mark.parametrize("ramped", [False, True])
@pytest.mark.parametrize("held", [(), ("waist_pitch",)])
def test_the_derivative_equals_finite_differences(model, ramped, held):
    rng = np.random.default_rng(3)
    command_model = make_command_model(model, make_map(rng, held))
    space = command_model.space
    qpos = make_morphology("g1").standing_qpos()
    qpos[3:7] = quat_exp(np.array([0.1, -0.2, 0.7]))
    settled = space.neutral + 0.05 * rng.normal(size=len(space))
    command = space.neutral + 0.1 * rng.normal(size=len(space))
    executed = command + 0.1 * space.max_rate * DT * rng.normal(size=len(space))
    offset = 0.02 * rng.normal(size=len(space))
    start = Start(qpos, executed if ramped else None, None, offset, settled)
    future, got = command_model.linearise(start, command, DT, Mode.STATIONARY)
    many = replace(start, qpos=qpos[None])
    batch = command_model.extrapolate(many, command[None], DT, Mode.STATIONARY)
    np.testing.assert_allclose(future, batch[0], atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(len(command))):
        ahead, behind = (
            command_model.extrapolate(start, command + sign * step, DT, Mode.STATIONARY)
            for sign in (1, -1)
        )
        tangent = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, tangent, 2e-6, behind, ahead)
        np.testing.assert_allclose(got[:, i], tangent, atol=1e-7)


def test_a_joint_that_is_held_stays_while_the_robot_stands(model):
    """A policy that bows by its pelvis does not bend the waist; walking it does nothing of this."""
    rest = make_map(np.random.default_rng(4), held=("waist_pitch",))
    command_model = make_command_model(model, rest)
    qpos = make_morphology("g1").standing_qpos()
    address = model.joint("waist_pitch_joint").qposadr[0]
    command = command_model.space.neutral.copy()
    command[PITCH] = 0.3
    stands = command_model.extrapolate(Start(qpos), command, 60.0, Mode.STATIONARY)
    walks = command_model.extrapolate(Start(qpos), command, 60.0, Mode.MOBILE)
    assert stands[address] == 0
    assert walks[address] == pytest.approx(0.3)


def test_a_body_that_may_not_move_is_not_asked_to_lean(model):
    command_model = make_command_model(model, make_map(np.random.default_rng(5)))
    body = np.zeros(len(command_model.space), dtype=bool)
    body[1] = True
    command_model.body = body
    qpos = make_morphology("g1").standing_qpos()
    command = command_model.space.neutral.copy()
    command[[HEIGHT, PITCH]] = 0.5, 0.4
    got = command_model.extrapolate(Start(qpos), command, 60.0, Mode.STATIONARY)
    np.testing.assert_array_equal(got[3:7], qpos[3:7])


# -- policies ----------------------------------------------------------------------------------


def test_the_policy_that_ships_rests_as_its_table_says():
    """Off the grid too, to 0.05 rad and 1 cm; the table belongs to these weights."""
    policy = make_policy("default")
    assert policy.rest is not None
    assert policy.rest.held == frozenset()
    commands = [(0.47, -0.4), (0.47, 0.0), (0.57, -0.2), (0.57, 0.2), (0.68, 0.4)]
    n, space = len(commands), make_morphology("g1").command_space
    final = np.tile(space.neutral, (n, 1))
    final[:, [HEIGHT, PITCH]] = commands
    arms = np.tile(make_morphology("g1").rest_action().arms, (n, 1))
    simulation, memory = make_simulation(n, policy=policy), policy.initial_memory(n)
    for step in range(300):
        command = space.neutral + min(step / 150, 1.0) * (final - space.neutral)
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, arms, memory, Mode.STATIONARY
        )
        simulation.step(targets)
    pitch = np.arcsin(compute_projected_gravity(simulation.qpos[:, 3:7])[:, 0])
    simulation.close()
    got = policy.rest(final[:, HEIGHT], final[:, PITCH])
    np.testing.assert_allclose(got.pitch, pitch, atol=0.05)


def test_a_policy_of_one_height_has_nothing_to_measure(monkeypatch):
    policy = make_policy("default")
    one = {Mode.STATIONARY: {"height": (0.7, 0.7)}, Mode.MOBILE: {"height": (0.7, 0.7)}}
    monkeypatch.setattr(policy, "ranges", one)
    with pytest.raises(BadValue) as error:
        measure_rest(policy)
    assert str(error.value) == "the policy has one height, 0.7: nothing to measure"
