"""Changes while the robot is driven: checked, atomic, smooth, and effective."""

from __future__ import annotations

import dataclasses
import threading
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.test_teleoperation import PINCHED, SMALL, Rig, make_frame, person, rig, stand  # noqa: F401
from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose, quat_from_rpy, quat_multiply, rotation_error
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.tuning import CostWeights
from xop_lerobot.operator.gestures import DoublePinchConfig, Gesture, GestureConfig, GestureReader
from xop_lerobot.retarget.changes import (
    WEIGHT_NAMES,
    Change,
    apply_change,
    join_change,
    make_settings,
    make_toggle,
    parse_change,
    split_change,
)
from xop_lerobot.retarget.config import CONSTRAINTS, PRESETS, RetargeterConfig
from xop_lerobot.retarget.online import OnlineSettings
from xop_lerobot.retarget.presets import build_configs

OPEN = np.full(2, 0.08)


def start(robot: str = "rby1", **config):
    morphology = make_morphology(robot)
    return morphology, make_settings(morphology, RetargeterConfig(**config))


# -- the value -----------------------------------------------------------------------------


def test_a_change_survives_json():
    data = {
        "preset": "conservative",
        "weights": {"position": 2, "collision_range": "inf"},
        "variant": "v2",
        "targets": ["left_wrist"],
        "body": [],
        "constraints": {"upright": True},
        "mode": "mobile",
    }
    change = parse_change(data)
    assert change.mode is Mode.MOBILE
    assert change.weights["collision_range"] == np.inf
    assert change.to_dict() == data
    assert parse_change(change.to_dict()) == change


def test_settings_after_changes():
    morphology, now = start()
    assert (now.preset, now.targets, now.body) == ("default", ("head",), ())
    now = apply_change(morphology, now, Change(weights={"position": 2.0, "stance": 1.0}))
    now = apply_change(morphology, now, Change(weights={"stance": 3.0}))
    assert now.weights == {"position": 2.0, "stance": 3.0}
    now = apply_change(morphology, now, Change(preset="aggressive", weights={"control": 1.0}))
    assert (now.preset, dict(now.weights)) == ("aggressive", {"control": 1.0})
    now = apply_change(morphology, now, Change(variant="v2"))
    assert now.targets == ("left_wrist",)
    assert len(now.body) == 13
    now = apply_change(morphology, now, Change(constraints={"upright": True}))
    assert now.constraints == {"upright"}
    assert make_toggle("upright", now).constraints == {"upright": False}
    assert make_toggle("aggressive", now).preset == "default"
    assert make_toggle("table1", now).preset == "table1"


def test_settings_of_the_command_line():
    _, now = start(
        preset="table1", targets="head, left_wrist", body="torso_5,left_arm_0",
        constraints="upright",
    )  # fmt: skip
    assert (now.targets, now.body) == (("head", "left_wrist"), ("torso_5", "left_arm_0"))
    assert (now.preset, now.constraints) == ("table1", {"upright"})
    with pytest.raises(UnknownName, match=r"^unknown variant of g1 'v2'. Known: v1$"):
        start("g1", variant="v2")
    with pytest.raises(UnknownName, match="unknown target 'tail'. Known: head, left_wrist"):
        start(targets="tail")
    with pytest.raises(BadValue, match="target 'head' is named twice"):
        start(targets="head,head")


def test_weights_are_checked_by_name_and_range():
    assert set(WEIGHT_NAMES) == {each.name for each in dataclasses.fields(CostWeights)}
    for name in WEIGHT_NAMES:
        Change(weights={name: 0.5})
        for bad in (-1, float("nan"), 1e7, "much", None, True):
            with pytest.raises(BadValue, match=f"weight '{name}' must be a number"):
                Change(weights={name: cast(Any, bad)})


# -- presets -------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["g1", "rby1"])
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_whole(robot, preset):
    morphology, now = start(robot, preset=preset)
    configs = build_configs(morphology, RetargeterConfig(preset=preset))
    assert set(configs) == set(Mode)
    if preset == "default":
        assert configs == {mode: morphology.mpc_config(mode) for mode in Mode}
    heavier = apply_change(morphology, now, Change(weights={"position": 7.0}))
    configs = build_configs(morphology, RetargeterConfig(num_samples=9, horizon=4), heavier)
    for config in configs.values():
        assert (config.num_samples, config.horizon, config.weights.position) == (9, 4, 7.0)


TABLE1 = {  # robot, variant, mode -> N, H, noise, control rate
    ("g1", "v1", Mode.STATIONARY): (30, 3, 0.001, 25),
    ("g1", "v1", Mode.MOBILE): (30, 5, 0.05, 10),
    ("rby1", "v1", Mode.STATIONARY): (30, 3, 0.01, 25),
    ("rby1", "v1", Mode.MOBILE): (30, 10, 0.01, 10),
    ("rby1", "v2", Mode.STATIONARY): (50, 3, 0.01, 25),
}


PRINTED = {
    "position", "orientation", "tilt_share", "stance", "collision", "collision_velocity",
    "collision_decay", "collision_velocity_decay", "collision_range", "upright", "control",
    "terminal",
}  # fmt: skip
"""Weights of the paper's cost terms."""


@pytest.mark.parametrize("preset", ["table1", "table1_charitable"])
@pytest.mark.parametrize("case", TABLE1, ids=str)
def test_table1_has_the_numbers_of_table_1(case, preset):
    robot, variant, mode = case
    morphology, now = start(robot, preset=preset, variant=variant)
    config = build_configs(morphology, RetargeterConfig(), now)[mode]
    noise = set(config.noise_std.values())
    assert (config.num_samples, config.horizon, noise.pop(), config.control_hz) == TABLE1[case]
    assert not noise
    # Its costs are sums over the horizon; those of means at λ / H and w_f / H are the same.
    assert config.temperature * config.horizon == pytest.approx(0.001)
    assert config.weights.terminal * config.horizon == pytest.approx(1.0)
    assert config.weighting == "raw"
    weights = config.weights
    assert (weights.position, weights.orientation, weights.control, weights.stance) == (
        1.0, 1.0, 0.1, 0.1,
    )  # fmt: skip
    assert (weights.collision, weights.collision_velocity) == (1.0, 1.0)
    assert (weights.collision_decay, weights.collision_velocity_decay) == (1.0, 10.0)
    assert weights.upright == 1.0
    # None of what this project adds.
    assert {getattr(weights, name) for name in set(WEIGHT_NAMES) - PRINTED} == {0.0}
    assert (config.preview_s, config.extrapolation_s) == (0, 0)
    assert (config.candidates, config.aids) == ((), ())
    literal = preset == "table1"
    assert config.importance_cost == literal
    assert config.control_reference == ("zero" if literal else "neutral")


# -- hand-over -----------------------------------------------------------------------------


def test_changes_are_all_or_nothing_and_hold_from_the_next_tick():
    online = OnlineSettings(make_morphology("rby1"), RetargeterConfig())
    online.request(Change(preset="conservative"), "call")
    with pytest.raises(UnknownName):
        online.request(Change(preset="aggressive", targets=("tail",)), "call")
    online.request(Change(mode=Mode.MOBILE), "key")
    assert online.current.preset == "default"
    assert [each.source for each in online.take()] == ["call", "key"]
    assert online.current.preset == "conservative"
    assert online.take() == ()


def settings_parts(number: int) -> list[dict]:
    """One of many requests, each of which sets something else."""
    names = sorted(set(WEIGHT_NAMES) - {"collision_range"})
    return [
        {"weights": {names[number % len(names)]: 1.0 + number}},
        {"weights": {"position": 2.0, "terminal": 1.0 + number}},
        {"preset": PRESETS[number % len(PRESETS)]},
        {"preset": "default", "weights": {"stance": 3.0}},
        {"variant": ("v1", "v2")[number % 2]},
        {"targets": [("head", "left_wrist")[number % 2]]},
        {"body": []},
        {"constraints": {"upright": bool(number % 2)}},
        {"mode": ("stationary", "mobile")[number % 2]},
    ]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    asked=st.lists(
        st.tuples(st.integers(0, 8), st.integers(0, 40), st.sampled_from(["call", "key"])),
        max_size=60,
    )
)
def test_what_waits_for_the_tick_says_the_same_as_all_that_was_asked_for(asked):
    morphology = make_morphology("rby1")
    online = OnlineSettings(morphology, RetargeterConfig())
    before, modes = online.current, []
    for kind, number, source in asked:
        change = parse_change(settings_parts(number)[kind])
        online.request(change, source)
        modes += [] if change.mode is None else [change.mode]
    taken = [each.change for each in online.take()]
    # No part is set twice, so what waits is never more than there are parts.
    parts = [part for change in taken for part in split_change(change)]
    assert len(parts) == len(set(parts)) <= len(WEIGHT_NAMES) + len(CONSTRAINTS) + 5
    assert [change.mode for change in taken if change.mode is not None] == modes[-1:]
    for change in taken:
        before = apply_change(morphology, before, change)
    assert before == online.current


def test_a_change_is_made_of_its_parts():
    change = parse_change(
        {"preset": "default", "weights": {"stance": 2.0}, "body": [], "mode": "mobile"}
    )
    parts = split_change(change)
    assert list(parts) == [("preset",), ("weights", "stance"), ("body",), ("mode",)]
    assert join_change(parts) == change


def test_what_was_asked_for_anew_is_left_out_and_the_rest_keeps_who_asked():
    online = OnlineSettings(make_morphology("rby1"), RetargeterConfig())
    online.request(Change(weights={"position": 2.0}, constraints={"upright": True}), "key")
    for value in range(1, 2000):
        online.request(Change(weights={"position": float(value)}), "control")
    online.request(Change(mode=Mode.MOBILE), "gesture")
    assert [(each.source, each.change.to_dict()) for each in online.take()] == [
        ("key", {"constraints": {"upright": True}}),
        ("control", {"weights": {"position": 1999.0}}),
        ("gesture", {"mode": "mobile"}),
    ]


def test_a_tick_does_not_wait_for_a_change_that_is_being_checked():
    online = OnlineSettings(make_morphology("rby1"), RetargeterConfig())
    begun, go_on = threading.Event(), threading.Event()

    def make(coming) -> Change:
        del coming
        begun.set()
        go_on.wait(60)
        return Change(preset="aggressive")

    other = threading.Thread(target=online.request_from, args=(make, "call"))
    other.start()
    assert begun.wait(60)
    assert online.take() == ()
    assert online.current.preset == online.coming.preset == "default"
    go_on.set()
    other.join()
    assert online.take()[0].change.preset == "aggressive"


def test_thousands_of_changes_are_one_tick_of_work(rig, caplog):  # noqa: F811
    """One notice, one line of the log and one new set of parameters, however many were asked."""
    r = rig("rby1")
    r.run(0.2)
    configured = []
    configure = r.teleop._follower.configure
    r.teleop._follower.configure = lambda **new: (configured.append(new), configure(**new))
    for value in range(1, 601):
        r.teleop.change({"weights": {"position": float(value)}}, f"program {value % 7}")
        r.teleop.change({"mode": "mobile" if value % 2 else "stationary"})
    posted = r.teleop._board._count
    with caplog.at_level("INFO"):
        _, record = r.tick()
    assert len(record.changes) == 2
    assert record.settings["weights"] == {"position": 600.0}
    assert len(configured) == 1
    assert r.teleop._board._count == posted + 2
    told = [each.getMessage() for each in caplog.records if each.name.endswith(".display")]
    assert told == ["Mode: stationary.", "Weight position 600."]


def test_the_direct_baseline_has_a_mode_only():
    online = OnlineSettings(make_morphology("g1"), RetargeterConfig(type="direct"))
    online.request(Change(mode=Mode.MOBILE), "call")
    with pytest.raises(BadValue) as refusal:
        online.request(Change(mode=Mode.MOBILE, preset="default"), "call")
    assert str(refusal.value) == (
        "retargeter 'direct' has no presets, weights, targets or constraints; its mode alone can "
        "be changed"
    )


def test_changes_from_many_threads_arrive_whole(rig):  # noqa: F811
    r = rig("rby1")
    r.run(0.2)
    stop = threading.Event()
    failures: list[Exception] = []

    def disturb(number: int) -> None:
        rng = np.random.default_rng(number)
        try:
            while not stop.is_set():
                value = float(rng.uniform(0.5, 2))
                r.teleop.change({"weights": {"position": value, "terminal": value}})
                stop.wait(0.001)
        except Exception as failure:
            failures.append(failure)

    threads = [threading.Thread(target=disturb, args=(i,)) for i in range(3)]
    for thread in threads:
        thread.start()
    for _ in range(15):
        _, record = r.tick()
        weights = record.settings["weights"]
        assert weights["position"] == weights["terminal"]
        used = r.teleop.retargeter.configs[Mode.STATIONARY].weights
        assert used.position == used.terminal == weights["position"]
    stop.set()
    for thread in threads:
        thread.join()
    assert not failures


# -- in motion -----------------------------------------------------------------------------


def wander(r: Rig):
    """A person who walks, turns, bends and swings the hands."""
    begin = r.loop.state.time

    def motion(t: float):
        t -= begin
        head = (0.3 * np.sin(2 * t), 0.2 * np.sin(1.3 * t), 1.6 + 0.06 * np.cos(3 * t))
        frame = make_frame(t + begin, head, 0.5 * np.sin(1.7 * t))
        wrist = frame.left_wrist.copy()
        wrist[:3] += 0.08 * np.array([np.sin(4 * t), np.cos(5 * t), np.sin(3 * t)])
        return dataclasses.replace(frame, left_wrist=wrist)

    return motion


weights = st.dictionaries(
    st.sampled_from(sorted(set(WEIGHT_NAMES) - {"collision_range"})),
    st.floats(0.001, 1000.0),
    max_size=3,
)
changes = st.fixed_dictionaries(
    {},
    optional={
        "preset": st.sampled_from(PRESETS),
        "weights": weights,
        "variant": st.sampled_from(["v1", "v2"]),
        "targets": st.sampled_from([["head"], ["left_wrist"], ["head", "right_wrist"]]),
        "constraints": st.fixed_dictionaries({"upright": st.booleans()}),
        "mode": st.sampled_from(["stationary", "mobile"]),
    },
)


def assert_smooth(r: Rig, commands: list[np.ndarray], arms: list[np.ndarray]) -> None:
    space, dt = r.teleop.morphology.command_space, r.dt
    steps = np.diff(commands, axis=0)
    assert (np.abs(steps) <= space.max_rate * dt + 1e-6).all()
    assert (np.abs(np.diff(steps, axis=0)) <= space.max_accel * dt**2 + 2e-6).all()
    assert (np.array(commands) >= space.low - 1e-6).all()
    assert (np.array(commands) <= space.high + 1e-6).all()
    joints = r.teleop._arms.ik.num_joints
    assert np.abs(np.diff(arms, axis=0)[:, :joints]).max() <= 3.0 * dt + 1e-6


@pytest.mark.parametrize("robot", ["g1", "rby1"])
@settings(
    max_examples=3,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.lists(changes, min_size=8, max_size=8))
def test_no_change_makes_a_step(person, robot, data):  # noqa: F811
    r = Rig(robot, retargeter=dataclasses.replace(SMALL, num_samples=4, horizon=3))
    r.person.motion = wander(r)
    r.run(0.2)
    commands, arms = [r.loop.action.command], [r.loop.action.arms]
    applied = 0
    for each in data:
        if "variant" in each and each["variant"] not in r.morphology.variants:
            with pytest.raises(UnknownName):
                r.teleop.change(each)
        elif set(each) and each != {"weights": {}}:
            r.teleop.change(each)
            applied += 1
        for action, record in r.run(0.12):
            commands.append(action.command)
            arms.append(action.arms)
            applied -= len([c for c in record.changes if c.source == "call"])
    r.close()
    assert applied == 0
    assert_smooth(r, commands, arms)


@pytest.mark.slow
def test_a_hand_that_drives_torso_and_arm_and_back_makes_no_step(rig):  # noqa: F811
    r = rig("rby1")
    r.person.motion = wander(r)
    r.run(0.3)
    commands, arms = [r.loop.action.command], [r.loop.action.arms]
    for variant in ("v2", "v1", "v2", "v1"):
        r.teleop.change({"variant": variant})
        for action, _ in r.run(0.4):
            commands.append(action.command)
            arms.append(action.arms)
        decided = set(r.teleop._follower.current.plan.arms)
        assert decided == ({f"left_arm_{i}" for i in range(7)} if variant == "v2" else set())
    assert_smooth(r, commands, arms)
    assert np.abs(np.diff(arms, axis=0)).max() > 0.001


@pytest.mark.slow
def test_a_hand_that_is_freed_from_a_constraint_turns_to_its_goal_slowly(rig):  # noqa: F811
    """From how the robot holds its hand, which the constraint kept level, within a second."""
    r = rig("rby1")
    tilted = quat_multiply(make_frame(0.0).left_wrist[3:], quat_from_rpy(0.6, 0, 0))

    def motion(t: float):
        frame = make_frame(t)
        return dataclasses.replace(frame, left_wrist=make_pose(frame.left_wrist[:3], tilted))

    r.person.motion = motion
    r.teleop.change({"variant": "v2", "constraints": {"upright": True}})
    r.run(39 * r.dt)
    _, record = r.tick()
    assert record.goal is not None
    held = r.teleop._compute_frames(record.state)["left_wrist"]
    asked = record.goal.poses["left_wrist"]
    assert np.linalg.norm(rotation_error(asked[3:], held[3:])) > 0.4
    r.teleop.change({"constraints": {"upright": False}})
    goals = [record.goal.poses["left_wrist"] for _, record in r.run(1.3)]
    away = [float(np.linalg.norm(rotation_error(goal[3:], held[3:]))) for goal in goals]
    assert away[0] < 0.05
    assert np.diff(away).max() < 0.1
    np.testing.assert_allclose(goals[-1], asked, atol=1e-3)


@pytest.mark.slow
def test_a_refused_change_changes_nothing_in_mid_motion(rig):  # noqa: F811
    ends = []
    for disturb in (False, True):
        r = rig("rby1")
        r.person.motion = wander(r)
        for _ in range(10):
            if disturb:
                with pytest.raises(UnknownName):
                    r.teleop.change({"preset": "aggressive", "targets": ["tail"]})
            _, record = r.tick()
            assert record.changes == ()
        ends.append(r.loop.state.qpos)
    np.testing.assert_array_equal(*ends)


def test_the_mode_can_be_changed_over_a_device_that_states_one(rig):  # noqa: F811
    r = rig("rby1")
    r.person.motion = lambda t: make_frame(t, mode=Mode.STATIONARY)
    r.run(0.2)
    r.teleop.change({"mode": "mobile"})
    action, record = r.tick()
    assert action.mode is Mode.MOBILE
    assert record.settings["mode"] == "mobile"
    assert record.changes[0].to_dict() == {"source": "call", "change": {"mode": "mobile"}}
    assert r.run(0.2)[-1][0].mode is Mode.MOBILE
    # Until the device says something else.
    r.person.motion = lambda t: make_frame(t, mode=Mode.MOBILE)
    assert r.run(0.2)[-1][0].mode is Mode.MOBILE
    r.person.motion = lambda t: make_frame(t, mode=Mode.STATIONARY)
    assert r.run(0.4)[-1][0].mode is Mode.STATIONARY
    assert {c.source for _, t in r.run(0.1) for c in t.changes} == set()


# -- gestures ------------------------------------------------------------------------------


def pinches(left: tuple[float, ...], right: tuple[float, ...]):
    """Frames in which each hand is pinched for 0.16 s from the given times on."""

    def motion(t: float):
        closed = [any(at <= t < at + 0.16 for at in times) for times in (left, right)]
        return make_frame(t, pinch=np.where(closed, 0.005, OPEN))

    return motion


def read(motion, until: float = 4.0, **config) -> list[tuple[float, Gesture]]:
    reader = GestureReader(GestureConfig(**config))
    times = np.arange(0, until, 0.02)
    seen = [(float(t), reader.update(motion(t))) for t in times]
    return [(t, gesture) for t, gesture in seen if gesture is not None]


PAIR = (0.5, 0.82)


def test_one_hand_is_not_delayed():
    ((time, gesture),) = read(pinches(PAIR, ()))
    assert gesture is Gesture.DOUBLE_PINCH
    assert time == pytest.approx(0.82 + 0.16 + 0.4, abs=0.04)


@pytest.mark.parametrize("lag", [0.0, 0.1, -0.1, 0.3, -0.3])
def test_both_hands_are_one_gesture(lag):
    ((_, gesture),) = read(pinches(PAIR, tuple(at + lag for at in PAIR)))
    assert gesture is Gesture.BOTH_DOUBLE_PINCH


@pytest.mark.parametrize("right", [(0.6,), (0.5, 0.82, 1.14)])
def test_another_thing_of_the_other_hand_leaves_the_toggle(right):
    """A grasp with one pinch, three pinches."""
    gestures = [gesture for _, gesture in read(pinches(PAIR, right))]
    assert gestures == [Gesture.DOUBLE_PINCH]


def test_double_pinches_of_the_hands_far_apart_in_time_are_two_gestures():
    gestures = [gesture for _, gesture in read(pinches(PAIR, (1.7, 2.02)))]
    assert gestures == [Gesture.DOUBLE_PINCH, Gesture.OTHER_DOUBLE_PINCH]


def test_the_other_hand_alone_has_a_gesture_of_its_own():
    ((_, gesture),) = read(pinches((), PAIR))
    assert gesture is Gesture.OTHER_DOUBLE_PINCH
    ((_, gesture),) = read(pinches((), PAIR), double_pinch=DoublePinchConfig(hand="right"))
    assert gesture is Gesture.DOUBLE_PINCH


@pytest.mark.slow
def test_both_hands_toggle_the_constraint(rig):  # noqa: F811
    r = rig("rby1")
    begin = r.loop.state.time
    shifted = tuple(begin + at for at in PAIR)
    r.person.motion = pinches(shifted, shifted)
    ticks = r.run(2.0)
    (change,) = [change for _, record in ticks for change in record.changes]
    assert change.to_dict() == {
        "source": "gesture", "change": {"constraints": {"upright": True}},
    }  # fmt: skip
    assert ticks[-1][1].settings["constraints"] == ["upright"]
    assert ticks[-1][0].mode is Mode.STATIONARY
