"""The simulated person: sees late and in part, moves as people do, corrects, gives up."""

from dataclasses import replace

import numpy as np
import pytest
from toy_world import DT, ToyWorld, make_body

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose, quat_log, quat_multiply, quat_yaw
from xop_lerobot.core.transforms import quat_conjugate as conjugate
from xop_lerobot.operator.devices import DeviceConfig, make_device
from xop_lerobot.operator.display import SeenObject, View
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.tasks.person.body import Body, relaxed_hands
from xop_lerobot.tasks.person.box_pick_and_place import bring_up
from xop_lerobot.tasks.person.device import SimulatedDevice
from xop_lerobot.tasks.person.hands import LARGEST_BEND
from xop_lerobot.tasks.person.intentions import INTENTIONS
from xop_lerobot.tasks.person.perception import Perception
from xop_lerobot.tasks.person.person import Person, draw_person

UNIT = np.array([1.0, 0, 0, 0])


def make_points(bearing: float = 0.4, distance: float = 1.2, height: float = 0.75) -> dict:
    middle = np.array([distance * np.cos(bearing), distance * np.sin(bearing), height])
    left = 0.18 * np.array([-np.sin(bearing), np.cos(bearing), 0])
    return {
        "left_point": SeenObject(make_pose(middle + left, UNIT)),
        "right_point": SeenObject(make_pose(middle - left, UNIT)),
    }


def make_person(seed: int = 0, noise: float = 1.0) -> SimulatedDevice:
    device = make_device(DeviceConfig(type="simulated", seed=seed, noise=noise))
    assert isinstance(device, SimulatedDevice)
    device.connect()
    return device


def run_touch(world: ToyWorld, device: SimulatedDevice, limit: float = 60.0) -> float:
    """Let the person touch both points; return the worst distance at the end [m]."""
    held, worst = 0.0, np.inf
    while world.time < limit and not device.is_finished(world.time):
        world.step(device)
        worst = max(
            float(np.linalg.norm(world.palm(s)[:3] - world.objects[f"{s}_point"].pose[:3]))
            for s in ("left", "right")
        )
        held = held + DT if worst < 0.05 else 0.0
        world.success |= held > 3.0
    return worst


def show(eyes: Perception, objects: dict[str, SeenObject], until: float) -> None:
    start = 0.0 if eyes.is_blind else eyes.time + DT
    for time in np.arange(start, until, DT):
        eyes.show(View(float(time), "", make_body(), objects))
    eyes.advance(until)


@pytest.mark.parametrize(
    "settings",
    [{}, {"lag": 0.8}, {"drift": (0.02, -0.02)}, {"deaf": 1}],
    ids=["follows", "slow", "drifts", "deaf"],
)
def test_touches_both_points_whatever_the_robot_is_like(settings: dict) -> None:
    world, device = ToyWorld(make_points(), **settings), make_person(3)
    assert run_touch(world, device) < 0.05
    assert world.success
    assert device.mind.diary[-1][1] == "done"


@pytest.mark.parametrize("slide", [(-0.4, 0.1), (0.1, 0.35)])
def test_aims_beyond_once_it_knows_that_the_robot_drifts(slide: tuple[float, float]) -> None:
    world, device = ToyWorld(make_points(), slide=slide), make_person(3)
    stood: list[np.ndarray] = []
    while len(stood) < 2:  # it is never told of a success, so it approaches again
        last = world.mode
        world.step(device)
        if last is Mode.MOBILE and world.mode is Mode.STATIONARY:
            stood.append(world.frames["head"][:2])
        assert world.time < 60
    # Now it stands about where it would have the first time without the drift.
    assert np.linalg.norm(stood[1] - (stood[0] - slide)) < 0.15


@pytest.mark.slow
def test_turns_round_for_what_is_behind() -> None:
    world, device = ToyWorld(make_points(bearing=2.8)), make_person(1)
    run_touch(world, device)
    assert world.success
    assert any("turn round" in text for _, text in device.mind.diary)


@pytest.mark.slow
def test_looks_to_both_sides_before_it_turns_round() -> None:
    world, device = ToyWorld(make_points(bearing=1.4)), make_person(1)
    run_touch(world, device)
    assert world.success
    assert not any("turn round" in text for _, text in device.mind.diary)


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.3, 0.4])
def test_squats_and_bends_for_what_is_low(height: float) -> None:
    world, device = ToyWorld(make_points(height=height)), make_person(3)
    standing = world.frames["head"][2]
    assert run_touch(world, device) < 0.05
    assert world.success
    person, posture = device.mind.person, device.mind.body.posture
    assert posture.drop == person.leg_bend
    assert 0.3 < posture.bend <= LARGEST_BEND
    # The head is lower than by the knees alone, and looks down with the trunk.
    knees = person.leg_bend * device.mind.belief.scale
    assert world.frames["head"][2] < standing - knees - 0.02
    assert posture.look[1] >= posture.bend


def test_stands_upright_where_a_squat_will_do() -> None:
    world, device = ToyWorld(make_points(height=0.55)), make_person(3)
    assert run_touch(world, device) < 0.05
    posture = device.mind.body.posture
    assert 0 < posture.drop < device.mind.person.leg_bend
    assert posture.bend == 0


def test_looks_down_for_what_is_known_to_be_low_at_its_feet() -> None:
    objects = make_points(bearing=0.0, distance=0.5, height=0.3)
    said = []
    for hints in ({"lowest": 0.3}, {}):
        world, device = ToyWorld(objects), make_person(3)
        view = world.view
        world.view = lambda view=view, hints=hints: replace(view(), hints=hints)
        run_touch(world, device, 8.0)
        said.append([text for _, text in device.mind.diary[:2]])
    assert said[0][0] == "look down"
    assert "look to both sides" not in said[0]
    assert said[1][0] == "look to both sides"


def test_lifts_what_it_took_from_below_to_a_good_height() -> None:
    world, device = ToyWorld(make_points()), make_person(3)
    for _ in range(10):
        world.step(device)
    mind = device.mind
    _ = mind.belief
    hands = relaxed_hands(mind.person.size)
    low = hands + np.array([0.2, 0, -0.4, 0, 0, 0, 0])
    raised = bring_up(mind, low)
    assert raised[:, 2].mean() == pytest.approx(-mind.person.reach_low * mind.person.size)
    assert raised[:, 0].mean() < low[:, 0].mean()
    assert raised[0, 1] - raised[1, 1] == pytest.approx(low[0, 1] - low[1, 1])


@pytest.mark.slow
def test_same_seed_same_person_and_another_is_another() -> None:
    def record(seed: int) -> np.ndarray:
        world, device = ToyWorld(make_points()), make_person(seed)
        for _ in range(250):
            world.step(device)
        return np.array([frame.left_wrist for frame in world.history])

    np.testing.assert_array_equal(record(5), record(5))
    assert np.abs(record(5) - record(6)).max() > 0.01


def test_people_differ_within_bounds() -> None:
    people = [draw_person(np.random.default_rng(seed)) for seed in range(200)]
    assert max(person.walk_speed for person in people) <= 0.6
    assert max(person.turn_speed for person in people) <= 1.0
    assert np.std([person.eye_height for person in people]) == pytest.approx(0.06, rel=0.2)


@pytest.mark.slow
def test_moves_no_faster_than_people_do() -> None:
    world, device = ToyWorld(make_points(bearing=-2.0)), make_person(2, noise=0.0)
    run_touch(world, device)
    head = np.array([frame.head for frame in world.history])
    place = np.linalg.norm(np.diff(head[:, :2], axis=0), axis=1) / DT
    turn = np.abs(np.diff(np.unwrap(quat_yaw(head[:, 3:])))) / DT
    assert 0.4 < place.max() <= 0.62
    assert 0.5 < turn.max() <= 1.01
    for name in ("left_wrist", "right_wrist"):
        wrist = np.array([frame.pose(name) for frame in world.history])
        reach = wrist[:, :3] - head[:, :3]
        assert np.linalg.norm(np.diff(reach, axis=0), axis=1).max() / DT < 1.5
        way = quat_log(quat_multiply(conjugate(wrist[:-1, 3:]), wrist[1:, 3:]))
        assert np.linalg.norm(way, axis=1).max() / DT < 4.0


def test_movements_are_smooth() -> None:
    body = Body(Person(), HumanNoise(0, scale=0.0))
    body.walk(replace(body.posture, place=np.array([2.0, 0.5, 1.0])))
    places = []
    for tick in range(160):
        body.advance(tick / 100)
        places.append(body.posture.place)
    body.halt()
    for tick in range(160, 320):
        body.advance(tick / 100)
        places.append(body.posture.place)
    speed = np.diff(places, axis=0) * 100
    assert np.abs(np.diff(speed, axis=0)).max() * 100 < 2.0  # acceleration, m/s² and rad/s²
    assert not body.is_moving
    np.testing.assert_array_equal(speed[-1], 0)


def test_knows_only_after_the_delay() -> None:
    person = Person()
    eyes = Perception(person, np.random.default_rng(0))
    here, there = make_pose(np.array([1.0, 0, 1]), UNIT), make_pose(np.array([1.0, 0.4, 1]), UNIT)
    show(eyes, {"box": SeenObject(here)}, 2.0)
    seen = eyes.pose("box").copy()
    assert np.linalg.norm(seen[:3] - here[:3]) < 0.12
    for time in np.arange(2.0, 2.0 + person.delay, 0.01):
        eyes.show(View(float(time), "", make_body(), {"box": SeenObject(there)}))
        eyes.advance(float(time))
        assert np.linalg.norm(eyes.pose("box")[:3] - seen[:3]) < 0.03
    eyes.advance(2.0 + person.delay + 0.05)
    assert eyes.pose("box")[1] > 0.3


def test_does_not_see_behind_but_remembers() -> None:
    eyes = Perception(Person(), np.random.default_rng(0))
    behind = {"box": SeenObject(make_pose(np.array([-1.0, 0, 1]), UNIT))}
    show(eyes, behind, 1.0)
    assert not eyes.knows("box")
    show(eyes, {"box": SeenObject(make_pose(np.array([1.0, 0, 1]), UNIT))}, 2.0)
    assert eyes.sees("box")
    show(eyes, behind, 2.5)  # what was before them has arrived by now
    last = eyes.pose("box").copy()
    show(eyes, behind, 3.0)
    assert not eyes.sees("box")
    np.testing.assert_array_equal(eyes.pose("box"), last)


def test_errors_grow_with_distance_but_not_between_neighbours() -> None:
    def look(distance: float, seed: int) -> np.ndarray:
        eyes = Perception(Person(), np.random.default_rng(seed))
        objects = {
            name: SeenObject(make_pose(np.array([distance, y, 1.0]), UNIT))
            for name, y in (("a", 0.0), ("b", 0.05))
        }
        show(eyes, objects, 1.0)
        truth = np.array([objects[name].pose[:3] for name in ("a", "b")])
        return np.array([eyes.pose(name)[:3] for name in ("a", "b")]) - truth

    near = np.array([look(0.5, seed) for seed in range(40)])
    far = np.array([look(2.0, seed) for seed in range(40)])
    rms = lambda errors: float(np.sqrt((errors**2).sum(-1).mean()))  # noqa: E731
    assert rms(far) > 2.5 * rms(near)
    assert rms(near[:, 0] - near[:, 1]) < rms(near[:, 0])


def test_gives_up_and_is_finished() -> None:
    world, device = ToyWorld(make_points(), deaf=100), make_person(0)
    run_touch(world, device)
    assert device.mind.diary[-1][1] == "gave up: could not change to mobile"
    assert device.is_finished(world.time)
    assert world.mode is Mode.STATIONARY


def test_sets_out_to_do_every_task() -> None:
    from xop_lerobot.tasks import (  # noqa: F401 they register themselves
        box_pick_and_place,
        dual_point_reach,
        dual_point_touch,
        non_prehensile_transport,
    )
    from xop_lerobot.tasks.task import TASKS

    assert set(INTENTIONS) == set(TASKS) - {"wait"}  # which test_collect adds


def test_nods_to_see_what_is_low() -> None:
    low = {"box": SeenObject(make_pose(np.array([0.3, 0, 0.75]), UNIT))}
    eyes = Perception(Person(), np.random.default_rng(0))
    show(eyes, low, 1.0)
    assert not eyes.knows("box")
    for time in np.arange(1.0, 2.0, DT):
        eyes.show(View(float(time), "", make_body(), low))
    eyes.advance(2.0, nod=0.4)
    assert eyes.sees("box")


def test_unknown_task_is_named() -> None:
    device = make_person()
    with pytest.raises(UnknownName, match="unknown task of the simulated operator 'juggle'"):
        device.see(View(0.0, "juggle", make_body()))


def test_needs_something_to_see() -> None:
    device = make_person()
    device.start(0.0)
    with pytest.raises(BadValue, match="'simulated' sees nothing to do: it needs a robot with a"):
        device.read(0.04)


def test_after_a_reset_the_same_person_tries_again_with_other_chance() -> None:
    world, device = ToyWorld(make_points()), make_person(4)
    for _ in range(100):
        world.step(device)
    person, last = device.mind.person, device.mind
    device.start(world.time)
    assert device.mind is not last
    assert device.mind.person == person
    assert device.mind.rng.random() != last.rng.random()
