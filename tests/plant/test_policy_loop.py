"""The policy loops: time in lock-step, limits, and on the wall clock the watchdog."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.low_level.base_drive import DiffDrive
from xop_lerobot.low_level.factory import make_policy
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy, PolicyOutput
from xop_lerobot.morphology.limits import ARM_MAX_SPEED, limit_action
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.plant.plant import Measurement, Plant
from xop_lerobot.plant.policy_loop import PolicyLoop
from xop_lerobot.plant.realtime_loop import RealtimeLoop
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.rollout import PolicyRollout

RBY1: Morphology = make_morphology("rby1")
SPACE = RBY1.command_space
REST = RBY1.rest_action()
NQ = len(RBY1.standing_qpos())
NUM_JOINTS = 14


class Diary(Plant):
    """A plant that does nothing but write down what is asked of it."""

    def __init__(self) -> None:
        self.time, self.applied, self.collides_at = 0.0, [], set()
        self.seeds, self.closed, self.measured = [], 0, 0
        self.failure: Exception | None = None

    def reset(self, seed: int | None = None) -> None:
        self.time = 0.0
        self.seeds.append(seed)
        self.applied.clear()

    def measure(self) -> Measurement:
        self.measured += 1
        qpos, qvel = RBY1.standing_qpos(), np.zeros(NQ - 1)
        return Measurement(
            time=self.time,
            qpos=qpos,
            qvel=qvel,
            effort=np.zeros(3),
            true_qpos=qpos,
            true_qvel=qvel,
            collision=round(self.time / POLICY_DT) in self.collides_at,
        )

    def apply(self, targets: np.ndarray) -> None:
        if self.failure is not None:
            raise self.failure
        self.applied.append(targets.copy())

    def step(self, dt: float) -> None:
        self.time += dt

    def render(self, camera: str) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        self.closed += 1


class Echo(LowLevelPolicy):
    """Its targets are what it was given; its memory counts its calls."""

    name = "echo"
    memory_size = 1

    def initial_memory(self, n: int = 1) -> np.ndarray:
        return np.zeros((n, 1))

    def act(self, qpos, qvel, command, arms, memory, mode) -> PolicyOutput:
        return PolicyOutput(
            np.concatenate([command, arms, np.full((1, 1), mode)], axis=1), memory + 1
        )


def make_loop() -> PolicyLoop:
    loop = PolicyLoop(RBY1, Diary(), Echo())
    loop.reset(settle_s=0.0)
    return loop


def get_diary(loop: PolicyLoop) -> Diary:
    assert isinstance(loop.plant, Diary)
    return loop.plant


def ask(mode: Mode = Mode.MOBILE, **entries: float) -> RobotAction:
    """The rest action with some entries of the command changed."""
    command = SPACE.neutral.copy()
    for name, value in entries.items():
        command[SPACE.index(name)] = value
    return RobotAction(command, mode, REST.arms)


# -- lock-step time ------------------------------------------------------------------------


@pytest.mark.parametrize("dt, calls", [(0.02, 1), (0.04, 2), (0.1, 5), (1 / 25, 2), (1 / 10, 5)])
def test_time_passes_in_periods_of_the_policy_inside_execute_alone(dt, calls):
    loop = make_loop()
    loop.execute(REST, dt)
    assert len(get_diary(loop).applied) == calls
    assert loop.state.time == pytest.approx(dt, abs=1e-12)
    assert loop.state.memory[0] == calls
    measured = get_diary(loop).measured
    for _ in range(3):
        assert loop.state.time == pytest.approx(dt, abs=1e-12)
    assert get_diary(loop).measured == measured  # reading costs no measurement


@pytest.mark.parametrize("dt", [0.03, 0.01, 1 / 30, 1 / 60])
def test_a_period_that_does_not_fit_is_refused(dt):
    loop = make_loop()
    with pytest.raises(BadValue) as caught:
        loop.execute(REST, dt)
    assert str(caught.value) == f"dt = {dt} s is not a whole multiple of the policy period 0.02 s"
    assert not get_diary(loop).applied


def test_reset_settles_the_robot_and_forgets():
    loop = make_loop()
    loop.execute(ask(v=0.5), 0.04)
    loop.reset(seed=7, settle_s=0.2)
    assert get_diary(loop).seeds[-1] == 7
    assert len(get_diary(loop).applied) == 10
    assert loop.state.memory[0] == 10
    # Rounded as every action is: what is predicted from it is what happens.
    np.testing.assert_array_equal(loop.state.command, REST.command.astype(np.float32))
    np.testing.assert_array_equal(loop.state.arms, REST.arms.astype(np.float32))
    assert loop.state.mode is Mode.STATIONARY


def test_closing_closes_the_plant():
    loop = make_loop()
    loop.close()
    assert get_diary(loop).closed == 1


# -- what is executed ----------------------------------------------------------------------


def test_what_is_returned_is_what_the_policy_was_given():
    loop = make_loop()
    wild = ask(v=3.0, torso_1=-5.0)
    for _ in range(5):
        executed = loop.execute(wild, 0.04)
        given = get_diary(loop).applied[-1]
        np.testing.assert_array_equal(given[: len(SPACE)], executed.command)
        np.testing.assert_array_equal(given[len(SPACE) : -1], executed.arms)
        assert given[-1] == Mode.MOBILE
        np.testing.assert_array_equal(loop.state.command, executed.command)
        np.testing.assert_array_equal(loop.state.arms, executed.arms)
        assert loop.state.mode is executed.mode


def test_commands_move_at_their_rate_from_what_was_executed_last():
    loop = make_loop()
    speeds = [loop.execute(ask(v=1.0), 0.04).command[0] for _ in range(30)]
    rate = SPACE.max_rate[0]
    rising = int(1 / (rate * 0.04))
    np.testing.assert_allclose(np.diff([0, *speeds[:rising]]), rate * 0.04, atol=1e-6)
    assert speeds[-1] == 1.0
    stopping = [loop.execute(ask(Mode.STATIONARY, v=1.0), 0.04).command[0] for _ in range(30)]
    assert stopping[0] == pytest.approx(1 - rate * 0.04, abs=1e-6)
    assert stopping[-1] == 0


def test_arms_move_at_their_speed_and_grippers_at_once():
    arms = REST.arms + 1.0
    limited = limit_action(RBY1, RobotAction(REST.command, Mode.STATIONARY, arms), REST, 0.04)
    moved = limited.arms - REST.arms
    np.testing.assert_allclose(moved[:NUM_JOINTS], ARM_MAX_SPEED * 0.04, atol=1e-6)
    np.testing.assert_allclose(moved[NUM_JOINTS:], 1.0, atol=1e-6)


actions = (
    st.integers(0, 2**32 - 1)
    .map(np.random.default_rng)
    .map(
        lambda rng: RobotAction(
            SPACE.neutral + 2 * rng.normal(size=len(SPACE)),
            Mode(int(rng.integers(2))),
            REST.arms + rng.normal(size=len(REST.arms)),
        )
    )
)


@given(actions, actions, st.sampled_from([0.02, 0.04, 0.1]))
@settings(max_examples=100)
def test_limiting_twice_is_limiting_once(action, previous, dt):
    """So the teleoperator's limited action is the one that the robot executes."""
    previous = limit_action(RBY1, previous, REST, 1.0)
    once = limit_action(RBY1, action, previous, dt)
    twice = limit_action(RBY1, once, previous, dt)
    np.testing.assert_array_equal(twice.command, once.command)
    np.testing.assert_array_equal(twice.arms, once.arms)
    # A dataset holds single precision.
    np.testing.assert_array_equal(once.command.astype(np.float32), once.command)
    np.testing.assert_array_equal(once.arms.astype(np.float32), once.arms)


def test_limiting_leaves_its_inputs_alone():
    action, arms = ask(v=9.0), REST.arms.copy()
    limit_action(RBY1, action, REST, 0.02)
    assert action.command[0] == 9.0
    np.testing.assert_array_equal(REST.arms, arms)


def test_a_command_of_the_wrong_shape_moves_nothing():
    loop = make_loop()
    with pytest.raises(BadShape) as caught:
        loop.execute(RobotAction(np.zeros(3), Mode.MOBILE, REST.arms), 0.02)
    assert str(caught.value) == "command must have shape (10,), got (3,)"
    assert not get_diary(loop).applied


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("part", ["command", "arms"])
def test_a_number_that_is_not_finite_moves_nothing(part, value):
    loop = make_loop()
    action = RobotAction(REST.command.copy(), Mode.MOBILE, REST.arms.copy())
    getattr(action, part)[3] = value
    with pytest.raises(BadValue) as caught:
        loop.execute(action, 0.02)
    assert str(caught.value) == f"{part} must be finite, got {getattr(action, part)}"
    assert not get_diary(loop).applied


def test_arms_of_the_wrong_shape_move_nothing():
    with pytest.raises(BadShape) as caught:
        make_loop().execute(RobotAction(REST.command, Mode.MOBILE, REST.arms[:5]), 0.02)
    assert str(caught.value) == "arms must have shape (16,), got (5,)"


# -- the published state -------------------------------------------------------------------


def test_a_state_never_changes_under_its_reader():
    loop = make_loop()
    state = loop.state
    for name in ("qpos", "qvel", "memory", "command", "arms", "effort", "true_qpos", "true_qvel"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(state, name)[...] = 1
    before = state.memory.copy()
    loop.execute(ask(v=1.0), 0.1)
    np.testing.assert_array_equal(state.memory, before)


def test_a_touch_within_the_tick_is_not_missed():
    loop = make_loop()
    get_diary(loop).collides_at = {2}
    assert not loop.state.collision
    loop.execute(REST, 0.1)
    assert loop.state.collision
    loop.execute(REST, 0.1)
    assert not loop.state.collision


@pytest.mark.parametrize("noise, speed, settled", [(0.03, 0.0, True), (0.0, 0.3, False)])
def test_a_robot_is_settled_as_far_as_its_sensors_tell(noise, speed, settled):
    """The truth, which a real robot does not know, plays no part; mild noise does not hide it."""
    loop, rng = make_loop(), np.random.default_rng(0)
    measure = loop.plant.measure

    def measure_noisily() -> Measurement:
        qvel = np.zeros(NQ - 1)
        qvel[:3] = noise * rng.standard_normal(3) + [speed, 0, 0]
        return dataclasses.replace(measure(), qvel=qvel, true_qvel=np.full(NQ - 1, np.nan))

    loop.plant.measure = measure_noisily
    for _ in range(200):
        loop.advance(POLICY_DT)
        assert loop.state.settled is settled


# -- the wall clock ------------------------------------------------------------------------


@pytest.fixture
def realtime():
    loop = RealtimeLoop(RBY1, Diary(), Echo())
    yield loop
    loop.close()


def wait_for(condition: Callable[[], bool], timeout: float = 120.0) -> None:
    """Wait until it holds; how long that takes is no matter."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.005)


def test_it_runs_by_itself_and_hands_actions_over(realtime):
    realtime.reset(settle_s=0.1)
    first = realtime.state.time
    assert first >= 0.1 - 1e-9
    executed = realtime.execute(ask(torso_5=0.5), 0.04)
    assert executed.command[SPACE.index("torso_5")] == pytest.approx(1.2 * 0.04, abs=1e-6)
    np.testing.assert_array_equal(realtime.state.command, executed.command)
    wait_for(lambda: realtime.state.time > first + 0.1)
    turned = SPACE.index("torso_5")
    assert realtime._loop.plant.applied[-1][turned] == executed.command[turned]
    state = realtime.state
    assert state.memory[0] == round(state.time / POLICY_DT)


def test_execute_limits_as_lock_step_does(realtime):
    realtime.reset(settle_s=0.0)
    lockstep = make_loop()
    for _ in range(3):
        np.testing.assert_array_equal(
            realtime.execute(ask(torso_1=1.2, torso_5=-0.4), 0.04).command,
            lockstep.execute(ask(torso_1=1.2, torso_5=-0.4), 0.04).command,
        )


def test_the_watchdog_stops_the_robot_and_keeps_its_posture(realtime):
    realtime.reset(settle_s=0.0)
    lean = REST.command[SPACE.index("torso_1")] + 0.05
    executed = [realtime.execute(ask(v=0.6, torso_1=lean), 0.04) for _ in range(60)][-1]
    assert executed.command[0] == pytest.approx(0.6)
    wait_for(lambda: realtime.state.command[0] == 0)
    state = realtime.state
    assert state.mode is Mode.STATIONARY
    np.testing.assert_array_equal(state.command[2:], executed.command[2:])
    np.testing.assert_array_equal(state.arms, executed.arms)
    # It slowed down at its rate, it did not jump.
    speeds = np.array([row[0] for row in realtime._loop.plant.applied])
    assert (np.abs(np.diff(speeds[np.argmax(speeds) :])) <= SPACE.max_rate[0] * 0.02 + 1e-6).all()
    # A new action drives on.
    assert realtime.execute(ask(v=0.6), 0.04).command[0] > 0


def test_the_watchdog_waits_for_half_a_second(realtime):
    """The clock of the watchdog is replaced: nothing here depends on how fast the machine is."""
    realtime.reset(settle_s=0.0)
    realtime._halt()
    for _ in range(30):
        realtime.execute(ask(v=0.6), 0.04)
    now = time.monotonic()
    realtime._handed_over = now + 100
    realtime._guard()
    assert realtime._loop.action.command[0] == pytest.approx(0.6)
    realtime._handed_over = now - 0.51
    realtime._guard()
    assert realtime._loop.action.command[0] == pytest.approx(
        0.6 - SPACE.max_rate[0] * 0.02, abs=1e-6
    )


G1 = make_morphology("g1")
VELOCITIES = G1.command_space.mobile_only


@pytest.fixture
def walker():
    """A G1, whose policy takes small velocities of a standing robot for its sway."""
    loop = RealtimeLoop(G1, Diary(), Echo())
    loop.reset(settle_s=0.0)
    loop._halt()
    yield loop
    loop.close()


def drive(loop: RealtimeLoop, mode: Mode, velocity: float, ticks: int = 40) -> RobotAction:
    """Let the G1 walk, or sway, ahead and aside."""
    command = G1.command_space.neutral.copy()
    command[VELOCITIES] = velocity
    wanted = RobotAction(command, mode, G1.rest_action().arms)
    return [loop.execute(wanted, 0.04) for _ in range(ticks)][-1]


def guard(loop: RealtimeLoop, periods: int) -> list[RobotAction]:
    """What the watchdog makes of the command when nobody sends one."""
    actions = []
    loop._handed_over = time.monotonic() - 60
    for _ in range(periods):
        loop._guard()
        actions.append(loop._loop.action)
    return actions


def test_the_watchdog_leaves_nothing_of_a_walk(walker):
    """A walking robot ends with velocities of zero, not with the sway of a standing one."""
    begin = drive(walker, Mode.MOBILE, 0.6)
    assert begin.command[VELOCITIES] == pytest.approx(0.6)
    actions = guard(walker, 100)
    speeds = np.array([action.command[VELOCITIES] for action in actions])
    np.testing.assert_array_equal(speeds[-1], 0.0)
    reach = G1.command_space.max_rate[VELOCITIES] * POLICY_DT
    assert (np.abs(np.diff(speeds, axis=0)) <= reach + 1e-6).all()
    # It is told to stand when it does, not before: else the rest would count as its sway.
    modes = [action.mode for action in actions]
    stopped = modes.index(Mode.STATIONARY)
    assert stopped > 5 and (np.abs(speeds[stopped:]) < 1e-6).all()
    assert set(modes[stopped:]) == {Mode.STATIONARY}
    for action in actions:
        resting = G1.command_space.compute_rest(action.command, action.mode)
        assert (np.abs(resting[VELOCITIES]) < 1e-6).all()
    rest = begin.command[~VELOCITIES]
    np.testing.assert_array_equal(actions[-1].command[~VELOCITIES], rest)
    np.testing.assert_array_equal(actions[-1].arms, begin.arms)


def test_the_watchdog_leaves_a_standing_robot_its_sway(walker):
    begin = drive(walker, Mode.STATIONARY, 0.08)
    actions = guard(walker, 50)
    np.testing.assert_array_equal(actions[-1].command, begin.command)
    assert actions[-1].mode is Mode.STATIONARY


def test_the_watchdog_leaves_nothing_of_a_walk_that_was_being_stopped(walker):
    drive(walker, Mode.MOBILE, 0.6)
    begin = drive(walker, Mode.STATIONARY, 0.0, ticks=2)
    assert (begin.command[VELOCITIES][:2] > 0.3).all()
    np.testing.assert_array_equal(guard(walker, 200)[-1].command[VELOCITIES], 0.0)


def test_each_silence_is_stopped_from_where_the_robot_is_then(walker):
    drive(walker, Mode.MOBILE, 0.6)
    guard(walker, 100)
    command = G1.command_space.neutral.copy()
    command[0] -= 0.02  # lower, and slow
    lower = [
        walker.execute(RobotAction(command, Mode.STATIONARY, G1.rest_action().arms), 0.04)
        for _ in range(20)
    ][-1]
    np.testing.assert_array_equal(guard(walker, 10)[-1].command, lower.command)


def test_a_failure_in_the_thread_reaches_the_caller(realtime):
    realtime.reset(settle_s=0.0)
    realtime._loop.plant.failure = RuntimeError("the motors are off")
    with pytest.raises(RuntimeError, match="^the motors are off$"):
        wait_for(lambda: realtime.state.time < 0)
    with pytest.raises(RuntimeError, match="^the motors are off$"):
        realtime.execute(REST, 0.04)


def test_after_a_reset_an_old_failure_is_forgotten(realtime):
    realtime.reset(settle_s=0.0)
    realtime._loop.plant.failure = RuntimeError("the motors are off")
    wait_for(lambda: realtime._failure is not None)
    realtime._loop.plant.failure = None
    realtime.reset(settle_s=0.0)
    assert realtime.state.time >= 0


def test_a_touch_between_two_observations_is_not_missed(realtime):
    realtime.reset(settle_s=0.0)
    realtime._halt()
    realtime._loop.plant.collides_at = {round(realtime.state.time / POLICY_DT) + 1}
    for _ in range(3):  # what the thread does between two calls of `state`
        realtime._loop.advance(POLICY_DT)
    assert realtime.state.collision
    assert realtime.state.collision  # the same state, until time passes
    realtime._loop.advance(POLICY_DT)
    assert not realtime.state.collision


def test_reset_starts_again_and_close_ends_the_thread(realtime):
    for _ in range(2):
        realtime.reset(seed=3, settle_s=0.04)
        wait_for(lambda: realtime.state.time > 0.1)
    realtime.close()
    realtime.close()
    assert not any(thread.name == "xop-policy" for thread in threading.enumerate())
    stopped = realtime.state.time
    time.sleep(0.06)
    assert realtime.state.time == stopped


def test_the_real_policy_takes_what_the_loop_gives():
    """Shapes fit: the wheels turn as the kinematics says."""
    loop = PolicyLoop(RBY1, Diary(), DiffDrive())
    loop.reset(settle_s=0.0)
    for _ in range(30):
        loop.execute(ask(v=1.0), 0.04)
    targets = get_diary(loop).applied[-1]
    assert (targets == -10.0).sum() == 2  # 1 m/s on wheels of 0.1 m


class Strong(Echo):
    """It was trained with motors of its own."""

    name = "strong"

    def adapt(self, model) -> None:
        model.actuator_gainprm[:, 0] = 777.0

    def act(self, qpos, qvel, command, arms, memory, mode) -> PolicyOutput:
        return PolicyOutput(np.zeros((len(qpos), 29)), memory + 1)


@pytest.mark.parametrize("kind", [PolicyLoop, RealtimeLoop])
def test_a_plant_has_the_motors_of_the_policy_that_drives_it(kind):
    plant = Simulation(G1)
    before = plant.model.actuator_gainprm[:, 0].copy()
    kind(G1, plant, Echo()).close()
    np.testing.assert_array_equal(plant.model.actuator_gainprm[:, 0], before)
    kind(G1, plant, Strong()).close()
    assert (plant.model.actuator_gainprm[:, 0] == 777.0).all()


def test_rollouts_have_the_motors_of_their_policy_and_the_model_keeps_its_own():
    model = build_model(G1, "planning")
    before = model.actuator_gainprm.copy()
    rollout = PolicyRollout(model, Strong(), 1)
    rollout.close()
    assert (rollout.model.actuator_gainprm[:, 0] == 777.0).all()
    np.testing.assert_array_equal(model.actuator_gainprm, before)


@pytest.mark.parametrize(("robot", "ramps"), [("g1", False), ("rby1", True)])
def test_targets_come_in_a_straight_line_where_the_controller_ramps(robot, ramps):
    """Over a whole tick of 40 ms, eight physics steps, the left elbow goes by 0.08 rad."""
    morphology = make_morphology(robot)
    plant = Simulation(morphology)
    loop = PolicyLoop(morphology, plant, make_policy(morphology.policies[0]))
    loop.reset(0, settle_s=0.1)
    joint = morphology.arms[0].joints[3]
    index, column = plant.model.actuator(joint).id, morphology.arm_names.index(joint)
    arms = loop.action.arms.copy()
    arms[column] += 0.08
    sent = []
    step = plant._step_once

    def note_and_step() -> None:
        sent.append(plant.data.ctrl[index])
        step()

    plant._step_once = note_and_step
    begin = plant.data.ctrl[index]
    executed = loop.execute(RobotAction(loop.action.command, Mode.STATIONARY, arms), 0.04)
    assert executed.arms[column] == pytest.approx(arms[column], abs=1e-6)
    moved = np.array(sent) - begin
    if ramps:
        np.testing.assert_allclose(moved, 0.01 * np.arange(1, 9), atol=1e-6)
    else:
        assert len(set(moved[:4])) == 1


def test_a_policy_keeps_the_arms_where_it_stands() -> None:
    """Robot and teleoperator limit alike, at the arms' rate, and only what the policy names."""
    morphology = make_morphology("g1")
    limits = make_policy("default").arm_limits
    assert set(limits) == {f"{side}_shoulder_pitch_joint" for side in ("left", "right")}
    rest = morphology.rest_action()
    action = RobotAction(rest.command, Mode.STATIONARY, np.full(14, 2.0))
    limited = limit_action(morphology, action, rest, 1.0, limits)
    kept = [morphology.arm_names.index(joint) for joint in limits]
    np.testing.assert_allclose(limited.arms[kept], 1.5)
    np.testing.assert_allclose(np.delete(limited.arms, kept), 2.0)
    again = limit_action(morphology, limited, limited, 0.04, limits)
    np.testing.assert_array_equal(again.arms, limited.arms)
    plant = Simulation(morphology, kind="planning")
    loop = PolicyLoop(morphology, plant, make_policy("default"))
    for _ in range(40):
        loop.execute(action, 0.04)
    np.testing.assert_allclose(loop.action.arms[kept], 1.5)
    loop.close()
