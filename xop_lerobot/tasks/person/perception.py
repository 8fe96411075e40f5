"""Perception of the robot's world: delayed, limited to the field of view, with errors."""

from __future__ import annotations

from collections import deque

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    level_pose,
    make_pose,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_exp,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
    quat_to_rpy,
    wrap_angle,
)
from xop_lerobot.operator.display import SeenObject, View
from xop_lerobot.tasks.person.person import Person

WINDOW = 0.4
"""Time over which movement is judged [s]."""
SETTLE = 0.3
"""Time constant of averaging what is seen while it is stationary [s]."""
JUMP = 0.06
"""Displacement beyond which a thing has moved and the average restarts [m]."""
WIDE = 0.8
"""Range to either side of the robot's head, and down, in which its cameras let a person look
[rad]."""
SHARED, OWN = 0.8, 0.6
"""Weights of the error that all things have in common and of each thing's own."""
TURN_NOISE = 0.02
"""Error of seen orientations [rad]."""
HANDS = ("left_wrist", "right_wrist", "left_palm", "right_palm")


class _Drift:
    """Slowly changing error: an Ornstein-Uhlenbeck process of unit variance. Shape (6,)."""

    def __init__(self, rng: np.random.Generator, time_constant: float) -> None:
        self._rng, self._time_constant = rng, time_constant
        self.value = rng.standard_normal(6)

    def advance(self, dt: float) -> None:
        keep = float(np.exp(-dt / self._time_constant))
        noise = self._rng.standard_normal(6)
        self.value = keep * self.value + np.sqrt(1 - keep * keep) * noise


class Perception:
    """What a person knows of the robot's world by now, from the views shown to it.

    A thing at distance d is seen at :math:`(1 + b)d` along the line of sight, where b is the
    person's own bias, plus a slowly changing error that grows with d. Most of that error is common
    to all things, so the distance between two neighbours is seen almost correctly. Outside the
    field of view a thing is remembered where it was last seen. Everything is seen from the robot's
    head, whose own position the person knows from floor and walls.

    Args:
        person: Delays, field of view and error sizes.
        rng: Random generator of the errors.
    """

    def __init__(self, person: Person, rng: np.random.Generator) -> None:
        self._person, self._rng = person, rng
        self._bias = float(rng.normal(0, person.depth_bias))
        self._drifts: dict[str, _Drift] = {}
        self._queue: deque[View] = deque()
        self._trail: deque[View] = deque()
        self._seen: dict[str, SeenObject] = {}
        self._in_view: set[str] = set()
        self._rest_reach = self._nod = 0.0
        self._heading: float | None = None
        self._first_look: np.ndarray | None = None

    def show(self, view: View) -> None:
        """Queue the robot's current view; the person perceives it after its delay."""
        if not self._queue and self.is_blind:
            self._rest_reach = _measure_reach(view)
            self._first_look = _measure_hand(view)
        self._queue.append(view)

    def advance(self, time: float, nod: float = 0.0, heading: float | None = None) -> None:
        """Perceive all views that have arrived by `time` [s] of the robot's clock.

        Args:
            time: Current time [s].
            nod: Pitch of the person's head, positive down [rad]. The robot's cameras see more than
                the headset shows, so the person can look further down than the robot's head does.
            heading: Direction the person looks, in the robot's world [rad]; None for that of the
                robot's head.
        """
        self._nod, self._heading = nod, heading
        while self._queue and self._queue[0].time <= time - self._person.delay + 1e-9:
            self._perceive(self._queue.popleft())

    @property
    def is_blind(self) -> bool:
        """Whether nothing has been perceived yet."""
        return not self._trail

    @property
    def _view(self) -> View:
        return self._trail[-1]

    @property
    def time(self) -> float:
        """Time of the latest perceived view [s, robot's clock]."""
        return self._view.time

    @property
    def task(self) -> str:
        """Name of the displayed task."""
        return self._view.task

    @property
    def mode(self) -> Mode:
        """Mode shown on the display."""
        return self._view.mode

    @property
    def success(self) -> bool:
        """Whether the display reports success."""
        return self._view.success

    @property
    def fallen(self) -> bool:
        """Whether the robot is seen to have fallen."""
        return self._view.fallen

    def look_over(self) -> None:
        """Remember roughly where everything is, as after looking over the scene before engaging."""
        for name, thing in self._view.objects.items():
            if name not in self._seen:
                blur = 5 * self._person.place_noise * self._rng.standard_normal(3)
                pose = make_pose(thing.pose[:3] + blur, thing.pose[3:])
                self._seen[name] = SeenObject(pose, np.array(thing.size))

    def recall(self, name: str, default: float) -> float:
        """Return the task's hint `name` [m], which a practised person knows."""
        return float(self._view.hints.get(name, default))

    def knows(self, name: str) -> bool:
        """Whether the thing has ever been seen."""
        return name in self._seen

    def sees(self, name: str) -> bool:
        """Whether the thing is in the field of view."""
        return name in self._in_view

    def pose(self, name: str) -> np.ndarray:
        """Pose of the thing where it is, or was last seen, in the robot's world. Shape (7,)."""
        return self._seen[name].pose

    def size(self, name: str) -> np.ndarray:
        """Half extents of the thing [m]. Shape (3,)."""
        return self._seen[name].size

    @property
    def rest_reach(self) -> float:
        """Distance of the waiting robot's palms ahead of its head [m].

        People look the robot over before they put the headset on.
        """
        return self._rest_reach

    @property
    def first_look(self) -> np.ndarray | None:
        """Left wrist in the head's frame before engaging, over head height. Shape (7,)."""
        return self._first_look

    @property
    def names(self) -> list[str]:
        """Names of all objects of the task, seen or not."""
        return list(self._view.objects)

    def compute_movement(self, names: tuple[str, ...]) -> float:
        """Largest displacement of these robot frames within the last `WINDOW` [m]."""
        first, last = self._trail[0].frames, self._view.frames
        if self._view.time - self._trail[0].time < 0.9 * WINDOW:
            return np.inf
        return max(float(np.linalg.norm(last[n][:3] - first[n][:3])) for n in names)

    def _perceive(self, view: View) -> None:
        dt = max(view.time - self._trail[-1].time, 0.0) if self._trail else 0.0
        self._trail.append(view)
        while view.time - self._trail[0].time > WINDOW + 1e-9:
            self._trail.popleft()
        for drift in self._drifts.values():
            drift.advance(dt)
        head = np.asarray(view.frames["head"], dtype=float)
        self._in_view = set()
        self._gaze = self._compute_gaze(head[3:])
        error = self._get_drift("head").value
        head_seen = make_pose(
            head[:3] + self._person.place_noise * error[:3],
            quat_multiply(quat_exp(0.25 * TURN_NOISE * error[3:]), head[3:]),
        )
        self._note("head", SeenObject(head_seen), dt)
        for name in HANDS:
            if name in view.frames:
                self._look_at(name, SeenObject(view.frames[name]), head, dt)
        for name, thing in view.objects.items():
            self._look_at(name, thing, head, dt)

    def _compute_gaze(self, head: np.ndarray) -> np.ndarray:
        """Orientation of the view: the robot's head, turned to the person's gaze. Shape (4,)."""
        down = max(self._nod - float(quat_to_rpy(head)[1]), 0.0)
        gaze = quat_multiply(head, quat_from_rpy(0, min(down, WIDE), 0))
        if self._heading is None:
            return gaze
        aside = float(wrap_angle(self._heading - compute_heading(head)))
        return quat_multiply(quat_from_yaw(float(np.clip(aside, -WIDE, WIDE))), gaze)

    def _look_at(self, name: str, thing: SeenObject, head: np.ndarray, dt: float) -> None:
        offset = quat_rotate(quat_conjugate(self._gaze), thing.pose[:3] - head[:3])
        if not self._is_in_view(offset, float(np.max(thing.size))):
            return
        self._in_view.add(name)
        person = self._person
        # Errors seen at the same time are correlated: relative positions stay nearly right.
        error = SHARED * self._get_drift("").value + OWN * self._get_drift(name).value
        distance = max(float(np.linalg.norm(offset)), 1e-6)
        ray = offset / distance
        along = float(error[:3] @ ray) * ray
        blur = person.place_noise * error[:3] + distance * (
            person.depth_noise * along + person.side_noise * (error[:3] - along)
        )
        seen = head[:3] + quat_rotate(self._gaze, (1 + self._bias) * offset + blur)
        quat = quat_multiply(quat_exp(TURN_NOISE * error[3:]), thing.pose[3:])
        self._note(name, SeenObject(make_pose(seen, quat), np.array(thing.size)), dt)

    def _is_in_view(self, offset: np.ndarray, radius: float) -> bool:
        """Whether the centre of a thing, or half its radius, is within the field of view."""
        wide, high = self._person.view_half_angles
        distance = float(np.linalg.norm(offset))
        slack = np.arctan2(0.5 * radius, max(distance, 1e-6))
        side = np.arctan2(offset[1], offset[0])
        up = np.arctan2(offset[2], np.hypot(offset[0], offset[1]))
        return bool(abs(side) <= wide + slack and abs(up) <= high + slack)

    def _get_drift(self, name: str) -> _Drift:
        if name not in self._drifts:
            self._drifts[name] = _Drift(self._rng, self._person.noise_s)
        return self._drifts[name]

    def _note(self, name: str, thing: SeenObject, dt: float) -> None:
        """Remember a thing: average its position while stationary, replace it once moved."""
        last = self._seen.get(name)
        if last is not None:
            step = thing.pose[:3] - last.pose[:3]
            if np.linalg.norm(step) < JUMP and name not in HANDS and name != "head":
                share = 1 - np.exp(-dt / SETTLE)
                thing = SeenObject(
                    make_pose(last.pose[:3] + share * step, thing.pose[3:]), thing.size
                )
        self._seen[name] = thing


def _measure_reach(view: View) -> float:
    """Distance from the head to the middle of the palms along the head's heading [m]."""
    head = view.frames["head"]
    palms = [pose[:3] for name, pose in view.frames.items() if name.endswith("_palm")]
    offset = np.mean(palms, axis=0) - head[:3]
    heading = compute_heading(head[3:])
    return float(offset[0] * np.cos(heading) + offset[1] * np.sin(heading))


def _measure_hand(view: View) -> np.ndarray:
    """Left wrist relative to the levelled head, position over head height. Shape (7,)."""
    head = view.frames["head"]
    wrist = pose_multiply(pose_inverse(level_pose(head)), view.frames["left_wrist"])
    return make_pose(wrist[:3] / head[2], wrist[3:])
