"""State synchronisation: optimum, limits, failures, noise, slips and falls, on three robots."""

from __future__ import annotations

from functools import cache

import mink
import mujoco
import numpy as np
import pytest
import toy_robot

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.transforms import quat_exp, quat_multiply, quat_yaw, wrap_angle
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.simulation import Simulation, SimulationConfig
from xop_lerobot.retarget.sync.config import SyncConfig, SyncStatus
from xop_lerobot.retarget.sync.state_sync import StateSync

ROBOTS = ("g1", "rby1", "rby1m", "toy")
DT = 0.04


@cache
def make_robot(name):
    morphology = make_morphology(name) if name != "toy" else toy_robot.Toy()
    return morphology, build_model(morphology, "planning")


@pytest.fixture(params=ROBOTS)
def robot(request):
    return make_robot(request.param)


def make_sync(robot, **settings):
    morphology, model = robot
    return StateSync(morphology, model, SyncConfig(**settings))


def perturb(model, qpos, rng, position=0.01, angle=0.005):
    """A measurement of `qpos` under white noise."""
    noise = rng.normal(size=model.nv) * np.array(
        [position] * 3 + [angle] * 3 + [angle] * (model.nv - 6)
    )
    noisy = qpos.copy()
    mujoco.mj_integratePos(model, noisy, noise, 1.0)
    return noisy


@cache
def record(name, noise, seed, mode=Mode.STATIONARY, seconds=8.0, **command):
    """States of a robot in the closed loop with noisy sensors."""
    return _record(name, noise, seed, mode, seconds, tuple(command.items()))


def _record(name, noise, seed, mode, seconds, command):
    morphology, _ = make_robot(name)
    simulation = Simulation(morphology, SimulationConfig(noise=noise))
    loop = PolicyLoop(morphology, simulation, make_policy(morphology.policies[0]))
    loop.reset(seed)
    rest = morphology.rest_action()
    wanted = rest.command.copy()
    for entry, value in command:
        wanted[morphology.command_space.names.index(entry)] += value
    states = []
    for _ in range(round(seconds / DT)):
        loop.execute(RobotAction(wanted, mode, rest.arms), DT)
        states.append(loop.state)
    loop.close()
    return states


def compute_errors(robot, states, mode, skip=50, **settings):
    """RMS errors of the base, raw and synchronised: position [m], velocity [m/s], heading [rad]."""
    sync = make_sync(robot, **settings)
    errors = []
    for state in states:
        synced = sync.synchronise(state.time, state.qpos, state.qvel, mode)
        truth, speed = state.true_qpos, state.true_qvel[:3]
        errors.append(
            [
                [
                    np.linalg.norm(one.qpos[:3] - truth[:3]),
                    np.linalg.norm(one.qvel[:3] - speed),
                    wrap_angle(quat_yaw(one.qpos[3:7]) - quat_yaw(truth[3:7])),
                ]
                for one in (state, synced)
            ]
        )
    assert sync.failures == 0
    return np.sqrt(np.mean(np.square(errors[skip:]), axis=0))


@pytest.mark.parametrize("mode", list(Mode))
def test_synchronises_every_robot_in_every_mode(robot, mode):
    morphology, model = robot
    synced = make_sync(robot).synchronise(0.0, morphology.standing_qpos(), np.zeros(model.nv), mode)
    assert synced.status in (SyncStatus.OK, SyncStatus.BOUNDED)
    assert synced.qpos.shape == (model.nq,)
    assert synced.qvel.shape == (model.nv,)
    assert not synced.qpos.flags.writeable
    assert not synced.qvel.flags.writeable
    assert synced.residual < 1e-4


@pytest.mark.parametrize("name", ["rby1", "toy"])
def test_a_settled_robot_without_noise_is_left_where_it_is(name):
    robot = make_robot(name)
    plant = Simulation(robot[0], SimulationConfig())
    plant.step(3.0)
    measured = plant.measure()
    sync = make_sync(robot)
    synced = [
        sync.synchronise(tick * DT, measured.qpos, measured.qvel, Mode.STATIONARY)
        for tick in range(20)
    ][-1]
    np.testing.assert_allclose(synced.qpos[:3], measured.qpos[:3], atol=1e-4)
    np.testing.assert_allclose(synced.qpos[3:], measured.qpos[3:], atol=3e-4)
    np.testing.assert_allclose(synced.qvel, measured.qvel, atol=1e-3)


def synchronise_all(sync, states, mode, expected):
    """Synchronise states in turn, each with the velocity in `expected`."""
    pairs = zip(states, expected, strict=True)
    return [sync.synchronise(s.time, s.qpos, s.qvel, mode, v) for s, v in pairs]


def compute_velocity_error(states, synced):
    pairs = zip(states[50:], synced[50:], strict=True)
    return np.sqrt(np.mean([np.square(y.qvel[:3] - s.true_qvel[:3]) for s, y in pairs]))


@pytest.mark.slow
def test_a_predicted_velocity_is_averaged_with_the_measured_one():
    states = record("g1", "mild", 0, Mode.MOBILE, vx=0.4)
    rng = np.random.default_rng(0)
    near = [state.true_qvel[:3] + 0.02 * rng.standard_normal(3) for state in states]
    robot = make_robot("g1")
    plain = synchronise_all(make_sync(robot), states, Mode.MOBILE, [None] * len(states))
    helped = synchronise_all(make_sync(robot), states, Mode.MOBILE, near)
    assert compute_velocity_error(states, helped) < 0.7 * compute_velocity_error(states, plain)


@pytest.mark.parametrize("bad", [np.full(3, 2.0), np.full(3, np.nan)])
def test_a_predicted_velocity_that_is_far_off_is_no_news(bad):
    states = record("g1", "mild", 0, Mode.STATIONARY, seconds=1.0)
    robot = make_robot("g1")
    plain = synchronise_all(make_sync(robot), states, Mode.STATIONARY, [None] * len(states))
    pushed = synchronise_all(make_sync(robot), states, Mode.STATIONARY, [bad] * len(states))
    for one, other in zip(plain, pushed, strict=True):
        np.testing.assert_array_equal(one.qpos, other.qpos)
        np.testing.assert_array_equal(one.qvel, other.qvel)


@pytest.mark.slow
def test_the_height_of_a_walking_robot_outlasts_the_foot_that_told_it():
    errors = []
    for seed in range(4):
        states = record("g1", "mild", seed, Mode.MOBILE, vx=0.4)
        sync = make_sync(make_robot("g1"))
        synced = synchronise_all(sync, states, Mode.MOBILE, [None] * len(states))
        pairs = zip(states[50:], synced[50:], strict=True)
        errors += [one.qpos[2] - state.true_qpos[2] for state, one in pairs]
    assert np.sqrt(np.mean(np.square(errors))) < 2.0e-3  # 2.3 mm if each contact stands alone


@pytest.mark.slow
@pytest.mark.parametrize("name", ["g1", "rby1"])
def test_a_robot_in_the_closed_loop_without_noise_is_left_where_it_is(name):
    sync = make_sync(make_robot(name))
    states = record(name, "off", 0, seconds=6.0)
    synced = synchronise_all(sync, states, Mode.STATIONARY, [None] * len(states))[-1]
    np.testing.assert_allclose(synced.qpos[:3], states[-1].true_qpos[:3], atol=3e-4)
    np.testing.assert_allclose(synced.qvel, states[-1].true_qvel, atol=5e-3)


def test_the_velocity_of_a_moving_robot_without_noise_stays():
    states = record("rby1", "off", 0, Mode.MOBILE, 6.0, v=0.4, yaw_rate=0.3)
    raw, synced = compute_errors(make_robot("rby1"), states, Mode.MOBILE)
    assert not raw.any()
    assert synced[0] < 1e-3
    assert synced[1] < 0.01


@pytest.mark.parametrize("mode", list(Mode))
def test_the_result_is_optimal(robot, mode):
    """The gradient of the cost vanishes, but for joints held by a limit, where it points out."""
    morphology, model = robot
    rng = np.random.default_rng(3)
    sync = make_sync(robot, recursive=False, tolerance=1e-9, iterations=10)
    qpos = perturb(model, morphology.standing_qpos(), rng)
    synced = sync.synchronise(0.0, qpos, np.zeros(model.nv), mode)
    configuration = mink.Configuration(model, synced.qpos)
    jacobian, error, _ = sync.task.compute_qp_residual(configuration)
    gradient = -error @ jacobian
    scale = np.abs(jacobian).T @ np.abs(error) + 1
    for joint in np.flatnonzero(model.jnt_limited):
        dof, angle = model.jnt_dofadr[joint], synced.qpos[model.jnt_qposadr[joint]]
        low, high = model.jnt_range[joint]
        assert low - 1e-8 <= angle <= high + 1e-8
        if angle < low + 1e-7:
            assert gradient[dof] > -1e-6 * scale[dof]
            gradient[dof] = 0
        elif angle > high - 1e-7:
            assert gradient[dof] < 1e-6 * scale[dof]
            gradient[dof] = 0
    assert np.abs(gradient / scale).max() < 1e-6


def test_the_cost_falls_with_every_step(robot):
    morphology, model = robot
    qpos = perturb(model, morphology.standing_qpos(), np.random.default_rng(0), 0.02, 0.02)
    costs = []
    for iterations in (1, 2, 4):
        sync = make_sync(robot, recursive=False, tolerance=1e-12, iterations=iterations)
        synced = sync.synchronise(0.0, qpos, np.zeros(model.nv), Mode.STATIONARY)
        assert synced.iterations == iterations
        error = sync.task.compute_qp_residual(mink.Configuration(model, synced.qpos))[1]
        costs.append(error @ error)
    assert costs[0] >= costs[1] - 1e-9 * costs[0]
    assert costs[2] == pytest.approx(costs[1], rel=1e-6)


def test_within_the_limits_daqp_takes_the_same_step(robot, monkeypatch):
    morphology, model = robot
    qpos = perturb(model, morphology.standing_qpos(), np.random.default_rng(1), angle=0.001)
    for joint in np.flatnonzero(model.jnt_limited):  # away from all limits
        low, high = model.jnt_range[joint]
        address = model.jnt_qposadr[joint]
        margin = 0.1 * (high - low)
        qpos[address] = np.clip(qpos[address], low + margin, high - margin)
    sync = make_sync(robot, recursive=False)
    plain = sync.synchronise(0.0, qpos, np.zeros(model.nv), Mode.STATIONARY)
    assert sync.num_qps == 0
    steps = []

    def ask_daqp(self):
        steps.append(1)
        return mink.solve_ik(self._configuration, [self.task], 1.0, solver="daqp",
                             damping=1e-9, limits=[self._limit]), False  # fmt: skip

    monkeypatch.setattr(StateSync, "_compute_step", ask_daqp)
    sync.reset()
    by_daqp = sync.synchronise(0.0, qpos, np.zeros(model.nv), Mode.STATIONARY)
    assert len(steps) == plain.iterations
    np.testing.assert_allclose(by_daqp.qpos, plain.qpos, atol=1e-9)


def measure_beyond_limit(robot):
    """A measurement with one joint 0.05 beyond its limit, its place in qpos and that limit."""
    morphology, model = robot
    joint = int(np.flatnonzero(model.jnt_limited)[-1])
    qpos = morphology.standing_qpos()
    address = int(model.jnt_qposadr[joint])
    qpos[address] = model.jnt_range[joint, 1] + 0.05
    return qpos, address, model.jnt_range[joint, 1]


def test_a_joint_measured_beyond_its_limit_ends_on_it(robot):
    qpos, address, high = measure_beyond_limit(robot)
    sync = make_sync(robot)
    synced = sync.synchronise(0.0, qpos, np.zeros(robot[1].nv), Mode.STATIONARY)
    assert synced.status is SyncStatus.BOUNDED
    assert sync.num_qps >= 1
    assert synced.qpos[address] == pytest.approx(high, abs=1e-8)


def test_a_solver_that_fails_leaves_the_measurement_and_is_counted(robot, monkeypatch):
    qpos, _, _ = measure_beyond_limit(robot)
    qvel = np.full(robot[1].nv, 0.01)
    sync = make_sync(robot)

    def fail(*args, **kwargs):
        raise mink.NoSolutionFound("daqp")

    with monkeypatch.context() as patch:
        patch.setattr(mink, "solve_ik", fail)
        for count in (1, 2):
            synced = sync.synchronise(count * DT, qpos, qvel, Mode.STATIONARY)
            assert synced.status is SyncStatus.MEASUREMENT
            assert sync.failures == count
            np.testing.assert_array_equal(synced.qpos, qpos)
            np.testing.assert_array_equal(synced.qvel, qvel)
    assert sync.synchronise(1.0, qpos, qvel, Mode.STATIONARY).status is SyncStatus.BOUNDED
    assert sync.failures == 2
    sync.reset()
    assert sync.failures == 0


def test_what_is_not_finite_gives_the_last_good_state(robot):
    morphology, model = robot
    sync, qpos, qvel = make_sync(robot), morphology.standing_qpos(), np.zeros(model.nv)
    broken = qpos.copy()
    broken[7] = np.nan
    first = sync.synchronise(0.0, broken, qvel, Mode.STATIONARY)
    assert first.status is SyncStatus.MEASUREMENT  # there is no good state yet
    good = sync.synchronise(DT, qpos, qvel, Mode.STATIONARY)
    for bad in ((broken, qvel), (qpos, np.full(model.nv, np.inf))):
        synced = sync.synchronise(2 * DT, *bad, Mode.STATIONARY)
        assert synced.status is SyncStatus.MEASUREMENT
        np.testing.assert_array_equal(synced.qpos, good.qpos)
    assert sync.failures == 3
    assert sync.synchronise(3 * DT, qpos, qvel, Mode.STATIONARY).status < SyncStatus.RESTARTED


def test_a_measurement_of_the_wrong_size_does_not_raise(robot):
    sync = make_sync(robot)
    synced = sync.synchronise(0.0, np.zeros(3), np.zeros(2), Mode.STATIONARY)
    assert synced.status is SyncStatus.MEASUREMENT
    assert sync.failures == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mode", "command", "position", "velocity"),
    [
        ("g1", Mode.STATIONARY, {}, 0.3, 0.75),
        ("g1", Mode.MOBILE, {"vx": 0.4, "yaw_rate": 0.2}, 0.5, 0.95),
        ("rby1", Mode.STATIONARY, {}, 0.3, 0.4),
        ("rby1", Mode.MOBILE, {"v": 0.4, "yaw_rate": 0.3}, 0.4, 0.4),
    ],
)
def test_mild_noise_is_reduced(name, mode, command, position, velocity):
    """To at most these shares of the raw error, for every seed."""
    for seed in range(2):
        states = record(name, "mild", seed, mode, 6.0, **command)
        raw, synced = compute_errors(make_robot(name), states, mode)
        assert synced[0] < position * raw[0]
        assert synced[1] < velocity * raw[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mode", "command"),
    [
        ("g1", Mode.STATIONARY, {}),
        ("g1", Mode.MOBILE, {"vx": 0.4, "yaw_rate": 0.2}),
        ("rby1", Mode.STATIONARY, {}),
        ("rby1", Mode.MOBILE, {"v": 0.4, "yaw_rate": 0.3}),
    ],
)
def test_harsh_noise_is_not_made_worse(name, mode, command):
    """Late, biased, with gaps: over several seeds, position, velocity and heading gain."""
    totals = np.zeros((2, 3))
    for seed in range(2):
        states = record(name, "harsh", seed, mode, 8.0, **command)
        totals += np.square(compute_errors(make_robot(name), states, mode))
    assert (totals[1] < totals[0]).all()


def test_many_seeds_of_white_noise_on_a_standing_humanoid():
    morphology, model = robot = make_robot("g1")
    truth, errors = morphology.standing_qpos(), []
    for seed in range(10):
        rng, sync, qpos = np.random.default_rng(seed), make_sync(robot), truth
        for tick in range(60):
            measured = perturb(model, truth, rng)
            qpos = sync.synchronise(tick * DT, measured, np.zeros(model.nv), Mode.STATIONARY).qpos
        errors.append(np.linalg.norm(qpos[:3] - truth[:3]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.006  # raw: 17 mm
    assert max(errors) < 0.012


def follow(robot, truths, *, mode=Mode.STATIONARY, seed=0):
    """Errors of the base [m] while the robot is at `truths`, under white noise. Shape (T,)."""
    _, model = robot
    rng, sync = np.random.default_rng(seed), make_sync(robot)
    errors, statuses = [], []
    for tick, truth in enumerate(truths):
        qvel = rng.normal(size=model.nv) * 0.02
        synced = sync.synchronise(tick * DT, perturb(model, truth, rng), qvel, mode)
        errors.append(np.linalg.norm(synced.qpos[:3] - truth[:3]))
        statuses.append(synced.status)
    return np.array(errors), statuses


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.02, 0.05, 0.3, 2.0])
def test_a_robot_that_is_pushed_away_is_found_again_within_a_second(robot, shift):
    """No velocity tells of the push: the worst case."""
    before = robot[0].standing_qpos()
    after = before.copy()
    after[:2] += shift * np.array([0.6, 0.8])
    errors, statuses = follow(robot, [before] * 50 + [after] * 50)
    assert errors[75:].max() < 0.015  # raw: up to 30 mm
    assert errors[53:].max() < 0.04  # soon as good as the raw measurement
    if shift > 0.1:
        assert SyncStatus.RESTARTED in statuses[50:52]
        assert errors[51] < 0.04


def test_a_foot_that_slips_with_the_robot_is_not_left_behind():
    """Both feet slide 6 cm in half a second, and the velocity says so."""
    morphology, model = robot = make_robot("g1")
    sync, rng = make_sync(robot), np.random.default_rng(0)
    errors = []
    for tick in range(100):
        slid = min(max(tick - 50, 0), 12) * 0.005
        truth, speed = morphology.standing_qpos(), np.zeros(model.nv)
        truth[0] += slid
        speed[0] = 0.125 if 50 < tick <= 62 else 0.0
        qpos = perturb(model, truth, rng)
        synced = sync.synchronise(tick * DT, qpos, speed, Mode.STATIONARY)
        errors.append(np.linalg.norm(synced.qpos[:3] - truth[:3]))
    assert max(errors[20:]) < 0.045  # raw: up to 30 mm
    assert max(errors[75:]) < 0.01


def test_a_step_of_one_foot_moves_its_place():
    morphology, model = robot = make_robot("g1")
    sync, rng = make_sync(robot), np.random.default_rng(0)
    standing = morphology.standing_qpos()
    lifted = standing.copy()
    for joint, bend in (("hip_pitch", -0.5), ("knee", 1.0), ("ankle_pitch", -0.5)):
        lifted[model.joint(f"left_{joint}_joint").qposadr[0]] += bend
    turned = standing.copy()  # the left foot stands turned outward afterwards
    turned[model.joint("left_hip_yaw_joint").qposadr[0]] += 0.3
    qpos = standing
    for tick in range(120):
        truth = standing if tick < 40 else lifted if tick < 60 else turned
        measured = perturb(model, truth, rng, angle=0.002)
        qpos = sync.synchronise(tick * DT, measured, np.zeros(model.nv), Mode.STATIONARY).qpos
        if 42 <= tick < 60:
            assert sync.stance.active == (1,)
    assert sync.stance.active == (0, 1)
    data = mujoco.MjData(model)
    data.qpos[:] = turned
    mujoco.mj_kinematics(model, data)
    places = sync.task.compute_places(data)
    np.testing.assert_allclose(sync.stance.places[:, :2], places[:, :2], atol=0.015)
    np.testing.assert_allclose(sync.stance.places[:, 2], places[:, 2], atol=0.03)
    assert np.linalg.norm(qpos[:3] - turned[:3]) < 0.015


def test_a_robot_that_has_fallen_stays_as_measured():
    """On its back, feet in the air: no contact holds, and the floor pulls nothing down."""
    morphology, model = robot = make_robot("g1")
    lying = morphology.standing_qpos()
    lying[2] = 0.15
    lying[3:7] = quat_multiply(quat_exp(np.array([0, -np.pi / 2, 0])), lying[3:7])
    errors, _ = follow(robot, [morphology.standing_qpos()] * 30 + [lying] * 30)
    assert errors[30:].max() < 0.05
    sync = make_sync(robot)
    synced = sync.synchronise(0.0, lying, np.zeros(model.nv), Mode.STATIONARY)
    assert sync.stance.active == ()
    assert synced.residual == 0
    np.testing.assert_allclose(synced.qpos, lying, atol=1e-9)


def test_wheels_that_do_not_turn_hold_the_base():
    """Neither a noisy position nor a noisy velocity moves a robot whose wheels stand still."""
    morphology, model = robot = make_robot("rby1")
    sync, rng = make_sync(robot), np.random.default_rng(0)
    truth, places = morphology.standing_qpos(), []
    for tick in range(200):
        qvel = np.zeros(model.nv)
        qvel[:3] = rng.normal(size=3) * 0.03
        qpos = perturb(model, truth, rng)
        places.append(sync.synchronise(tick * DT, qpos, qvel, Mode.STATIONARY).qpos[:2])
    late = np.array(places[100:])
    assert np.linalg.norm(late - truth[:2], axis=1).max() < 0.006
    assert np.linalg.norm(np.diff(late, axis=0), axis=1).max() < 0.003  # from tick to tick


def test_a_second_look_at_the_same_instant_and_a_clock_that_starts_over(robot):
    morphology, model = robot
    qpos, qvel, sync = morphology.standing_qpos(), np.zeros(model.nv), make_sync(robot)
    for time in (5.0, 5.0, 0.0, 100.0):
        synced = sync.synchronise(time, qpos, qvel, Mode.STATIONARY)
        assert synced.status < SyncStatus.RESTARTED
        np.testing.assert_allclose(synced.qpos[:3], qpos[:3], atol=1e-3)


def test_the_same_measurement_again_is_no_news(robot):
    morphology, model = robot
    rng, once, twice = np.random.default_rng(0), make_sync(robot), make_sync(robot)
    for tick in range(10):
        qpos = perturb(model, morphology.standing_qpos(), rng)
        arguments = (tick * DT, qpos, np.zeros(model.nv), Mode.STATIONARY)
        assert twice.synchronise(*arguments) is twice.synchronise(*arguments)
        first, second = once.synchronise(*arguments), twice.synchronise(*arguments)
        np.testing.assert_array_equal(first.qpos, second.qpos)


def test_reset_forgets(robot):
    morphology, model = robot
    far = morphology.standing_qpos()
    far[:2] += 5.0
    used, fresh = make_sync(robot), make_sync(robot)
    for tick in range(5):
        used.synchronise(tick * DT, morphology.standing_qpos(), np.zeros(model.nv), Mode.MOBILE)
    used.reset()
    arguments = (1.0, far, np.zeros(model.nv), Mode.STATIONARY)
    first, second = used.synchronise(*arguments), fresh.synchronise(*arguments)
    np.testing.assert_array_equal(first.qpos, second.qpos)
    assert first.status is second.status


def test_the_same_measurements_give_the_same_states(robot):
    name = robot[0].name
    if name == "toy":
        pytest.skip("the toy has no noisy recording")
    states = record(name, "mild", 0, Mode.STATIONARY, 6.0)[:40]
    runs = []
    for _ in range(2):
        sync = make_sync(robot)
        runs.append(
            [sync.synchronise(s.time, s.qpos, s.qvel, Mode.STATIONARY).qpos for s in states]
        )
    np.testing.assert_array_equal(*runs)


def test_a_setting_out_of_its_range_is_named():
    with pytest.raises(BadValue, match=r"^sync setting 'joint' must be over 0, got 0$"):
        SyncConfig(joint=0)
