"""Scenarios of the tracking benchmark: goals of the head over time, and their tolerances.

Goals are defined in the heading frame of the head at the start ("home"): X forward, Y left, Z up.
A stepping goal is held from its start on; arrival times count from the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.evaluation.bench import (
    CURVE_S,
    LEAD_IN_S,
    bend_from,
    make_curve,
    move_from,
)

WALK_SPEED = 0.5
"""Speed of the direct path that arrival times are compared with [m/s]."""
ARRIVAL_S = 3.0
"""Time limit of a mobile robot's arrival beyond that of the direct path [s]."""
STATIONARY_S = 1.5
"""Time limit of a stationary robot's arrival [s]."""
ROOM_HALF = 4.0
"""Half the inner width of the scene `room` [m]."""
ANYWHERE = 1.5
"""Maximum distance of the goals of `anywhere` from home [m]."""
WALL_DISTANCE = 0.25
"""Distance of the room's goals from the nearest wall [m]."""
ROOM_HOLD_S = 1.5
"""Time for which each of the room's goals is held after its time limit [s]."""


@dataclass(frozen=True)
class Tolerance:
    """Errors up to which a goal counts as reached.

    Attributes:
        position: Maximum position error [m].
        angle: Maximum angle of the orientation error [rad].
    """

    position: float
    angle: float


@dataclass(frozen=True)
class GoalStep:
    """One held goal.

    Attributes:
        start: Start of the goal on the track's clock [s].
        head: Pose of the head in the world. Shape (7,).
        direct_s: Duration of the direct path to it at `WALK_SPEED` [s].
        limit_s: Time limit of the arrival after `start` [s].
    """

    start: float
    head: np.ndarray
    direct_s: float
    limit_s: float


@dataclass(frozen=True)
class GoalTrack:
    """Goals of head and wrists over time.

    Attributes:
        home: Pose of the head at the start, in the world. Shape (7,).
        duration: Duration [s].
        steps: Held goals in order of time; empty for a moving goal.
        path: Pose of the moving goal as a function of time [s]; None for held goals.
        reach: Position of the left wrist from the head, in the head's heading frame; the right
            one mirrors it. None keeps the wrists as at home [m].
        reach_start: Time from which `reach` applies, and from which a moving goal moves [s].
    """

    home: np.ndarray
    duration: float
    steps: tuple[GoalStep, ...] = ()
    path: Callable[[float], np.ndarray] | None = None
    reach: np.ndarray | None = None
    reach_start: float = LEAD_IN_S

    def head_at(self, time: float) -> np.ndarray:
        """Return the head's goal at `time` [s] of the track's clock, in the world. Shape (7,)."""
        if self.path is not None:
            return self.path(time)
        head = self.home
        for step in self.steps:
            if time >= step.start - 1e-9:
                head = step.head
        return head


Builder = Callable[[np.ndarray, np.random.Generator, float, int], GoalTrack]
"""Makes a track from home (7,), a random generator, the hold time [s] and the number of goals."""


@dataclass(frozen=True)
class Scenario:
    """One scenario of the benchmark.

    Attributes:
        name: Name on the command line.
        title: Title in tables.
        mode: Mode of the robot.
        build: Makes the track.
        scene: Name of the scene.
        tolerances: Tolerances by robot; ``""`` for every other robot.
    """

    name: str
    title: str
    mode: Mode
    build: Builder
    scene: str = "empty"
    tolerances: dict[str, Tolerance] = field(default_factory=dict)

    def get_tolerance(self, robot: str) -> Tolerance:
        """Return the tolerance for `robot`."""
        return self.tolerances.get(robot, self.tolerances[""])


STATIONARY_TOLERANCE = {"": Tolerance(0.02, math.radians(3))}
MOBILE_TOLERANCE = {
    "": Tolerance(0.05, math.radians(3)),
    **dict.fromkeys(("rby1", "rby1m"), Tolerance(0.02, math.radians(1))),
}


def _hold_each(home: np.ndarray, heads: tuple[np.ndarray, ...], hold: float) -> GoalTrack:
    """Hold stationary goals one after the other, for `hold` [s] in all, at least 3 s each."""
    each = max(3.0, hold / len(heads))
    steps = tuple(
        GoalStep(LEAD_IN_S + i * each, head, 0.0, STATIONARY_S) for i, head in enumerate(heads)
    )
    return GoalTrack(home, LEAD_IN_S + each * len(heads), steps)


def _go(offset: tuple[float, float, float], yaw: float = 0) -> Builder:
    """Return a builder of one mobile goal, held for `hold` [s] after its time limit.

    Args:
        offset: Position of the goal from home, in home's heading frame [m].
        yaw: Heading of the goal relative to home's [rad].
    """

    def build(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
        del rng, num_goals
        direct = math.hypot(*offset) / WALK_SPEED
        step = GoalStep(LEAD_IN_S, move_from(home, offset, yaw), direct, direct + ARRIVAL_S)
        return GoalTrack(home, step.start + step.limit_s + hold, (step,))

    return build


def _squat(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    del rng, num_goals
    return _hold_each(home, (move_from(home, (0, 0, -0.15)), home), hold)


def _yaw(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    del rng, num_goals
    return _hold_each(home, (bend_from(home, yaw=0.5), bend_from(home, yaw=-0.5), home), hold)


def _pitch(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    del rng, num_goals
    heads = (bend_from(home, pitch=0.2), bend_from(home, pitch=-0.2), home)
    return _hold_each(home, heads, hold)


def _curve(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    del rng, hold, num_goals
    return GoalTrack(home, LEAD_IN_S + CURVE_S, path=make_curve(home))


def _anywhere(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    """Make a goal at a random place within `ANYWHERE` of home, with a random heading."""
    turn, far = rng.uniform(-math.pi, math.pi), ANYWHERE * math.sqrt(rng.uniform())
    offset = (far * math.cos(turn), far * math.sin(turn), 0.0)
    return _go(offset, rng.uniform(-math.pi, math.pi))(home, rng, hold, num_goals)


def _room(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    """Make goals at random places `WALL_DISTANCE` from a random wall, with random headings."""
    del hold
    steps, start, head = [], LEAD_IN_S, home
    for _ in range(num_goals):
        reach = ROOM_HALF - WALL_DISTANCE
        along = rng.uniform(-reach, reach)
        wall, heading = rng.integers(4), rng.uniform(-math.pi, math.pi)
        away = quat_rotate(quat_from_yaw(wall * math.pi / 2), np.array([reach, along, 0.0]))
        place = np.array([*away[:2], home[2]])
        level = quat_from_yaw(-compute_heading(home[3:]) + heading)
        goal = make_pose(place, quat_multiply(level, home[3:]))
        direct = float(np.linalg.norm(place - head[:3])) / WALK_SPEED
        steps.append(GoalStep(start, goal, direct, direct + ARRIVAL_S))
        start, head = start + direct + ARRIVAL_S + ROOM_HOLD_S, goal
    return GoalTrack(home, start, tuple(steps))


def _beyond(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    """Make a goal that a stationary robot can't reach: far away, low and tilted; then home."""
    del num_goals
    turn, far = rng.uniform(-math.pi, math.pi), rng.uniform(0.5, 1.0)
    bent = bend_from(home, yaw=rng.uniform(-2.5, 2.5), pitch=rng.uniform(-0.5, 0.8))
    offset = [far * math.cos(turn), far * math.sin(turn), -rng.uniform(0.0, 0.8)]
    return _hold_each(home, (make_pose(bent[:3] + offset, bent[3:]), home), hold)


def _arms(home: np.ndarray, rng: np.random.Generator, hold: float, num_goals: int) -> GoalTrack:
    """Make the motion of the paper's figure 2: arms forward and high, squat and pitch, back."""
    del num_goals
    reach = np.array([rng.uniform(0.35, 0.45), rng.uniform(0.1, 0.2), rng.uniform(-0.05, 0.1)])
    down, pitch = rng.uniform(0.15, 0.25), rng.uniform(0.3, 0.5)
    bent = bend_from(home, pitch=pitch)
    bent = make_pose(bent[:3] - np.array([0, 0, down]), bent[3:])
    each = max(4.0, hold / 2)
    steps = (
        GoalStep(LEAD_IN_S + 2.0, bent, 0.0, STATIONARY_S),
        GoalStep(LEAD_IN_S + 2.0 + each, home, 0.0, STATIONARY_S),
    )
    return GoalTrack(home, LEAD_IN_S + 2.0 + 2 * each, steps, reach=reach)


_STATIONARY = {
    "squat": ("head 0.15 m down and back", _squat),
    "yaw": ("waist yaw ±0.5 rad", _yaw),
    "pitch": ("waist pitch ±0.2 rad", _pitch),
}
_MOBILE = {
    "diagonal": ("0.8 m ahead, 0.3 m aside, 0.4 rad", _go((0.8, 0.3, 0), 0.4)),
    "ahead": ("2 m ahead", _go((2, 0, 0))),
    "sideways": ("1 m sideways", _go((0, 1, 0))),
    "quarter": ("a quarter turn", _go((0, 0, 0), math.pi / 2)),
    "curve": ("goal at 0.3 m/s on a curve", _curve),
}

SCENARIOS: dict[str, Scenario] = {
    **{
        name: Scenario(name, title, Mode.STATIONARY, build, tolerances=STATIONARY_TOLERANCE)
        for name, (title, build) in _STATIONARY.items()
    },
    **{
        name: Scenario(name, title, Mode.MOBILE, build, tolerances=MOBILE_TOLERANCE)
        for name, (title, build) in _MOBILE.items()
    },
    "anywhere": Scenario(
        "anywhere", "a random goal within 1.5 m", Mode.MOBILE, _anywhere, "empty", MOBILE_TOLERANCE
    ),
    "room": Scenario(
        "room", "goals 0.25 m from walls", Mode.MOBILE, _room, "room", MOBILE_TOLERANCE
    ),
    "beyond": Scenario(
        "beyond",
        "beyond what a robot on the spot can reach, and back",
        Mode.STATIONARY,
        _beyond,
        tolerances=STATIONARY_TOLERANCE,
    ),
    "arms": Scenario(
        "arms",
        "arms forward and high, squat and pitch",
        Mode.STATIONARY,
        _arms,
        tolerances=STATIONARY_TOLERANCE,
    ),
}
"""Scenarios by name."""

SCENARIO_GROUPS: dict[str, tuple[str, ...]] = {
    "stationary": ("squat", "yaw", "pitch"),
    "mobile": ("diagonal", "ahead", "sideways", "quarter"),
    "curve": ("curve",),
    "anywhere": ("anywhere",),
    "room": ("room",),
    "arms": ("arms",),
    "beyond": ("beyond",),
}
"""Groups of scenarios with the same metrics, one table each."""
