"""Path of a base that cannot go sideways, to a goal at rest: turn, drive, arrive.

`Footprint` is the part of the hull that goes with the base, and its clearance along a path.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.transforms import compute_heading, quat_yaw
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import Driving
from xop_lerobot.retarget.obstacles import Obstacle, ObstacleSet


class Footprint:
    """The hull's spheres that sit on the base itself, and the obstacles about them.

    Args:
        morphology: The robot.
        model: Its planning model.
        obstacles: What stands around it.
    """

    def __init__(
        self, morphology: Morphology, model: mujoco.MjModel, obstacles: Iterable[Obstacle] = ()
    ) -> None:
        base = model.body(morphology.base_body).id
        sites = [
            (model.site(name), radius)
            for name, radius in morphology.hull_points.items()
            if model.site(name).bodyid[0] == base
        ]
        self._points = np.array([site.pos for site, _ in sites]).reshape(-1, 3)
        self._points[:, 0] -= morphology.pivot
        self._radii = np.array([radius for _, radius in sites])
        self._height = float(morphology.standing_qpos()[2])
        self.set_obstacles(obstacles)

    def set_obstacles(self, obstacles: Iterable[Obstacle]) -> None:
        """Take other obstacles."""
        self._obstacles = ObstacleSet(obstacles)

    def compute_clearance(self, axle: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """Distance of the base to the nearest obstacle, negative inside; infinite without any [m].

        Args:
            axle: Places of the middle of the axle [m]. Shape (n, 2).
            headings: Headings there [rad]. Shape (n,).

        Returns:
            Shape (n,).
        """
        if not len(self._obstacles) or not len(self._points):
            return np.full(len(axle), np.inf)
        cosine, sine = np.cos(headings)[:, None], np.sin(headings)[:, None]
        points = np.empty((len(axle), len(self._points), 3))
        points[..., 0] = axle[:, None, 0] + cosine * self._points[:, 0] - sine * self._points[:, 1]
        points[..., 1] = axle[:, None, 1] + sine * self._points[:, 0] + cosine * self._points[:, 1]
        points[..., 2] = self._height + self._points[:, 2]
        distances = self._obstacles.compute_distances(points) - self._radii[:, None]
        return distances.min(axis=(1, 2))


_DT = 0.04  # step of the simulated way [s]
_FINE = 6.0  # gain of the last centimetres and degrees, where the braking law is too steep [1/s]
_FINE_DRIVE, _FINE_TURN = 0.05, 0.1  # within which that gain holds [m], [rad]
_BACKWARDS = 0.2  # turn that is preferred to driving backwards [rad]
_TWIST = 0.3  # how much a twist of the waist counts beside a turn of the base
_RESTING, _TURNING = 0.15, 0.45  # yaw rates of a goal that rests and of one that turns [rad/s]
_TWIST_RAMP = 0.3  # beyond which twist the base turns in earnest [rad]
_CLOSE = 0.12  # distance of the axle from its place at which it faces nothing anew [m]
_MUST_TURN = 0.05  # turn back into what the waist allows from which on it comes first [rad]
_CLOSE_TURNING = 0.35  # that distance meanwhile: a turn carries the head off [m]
_LINE_UP = 0.2  # distance of the place at which its heading counts like the way to it [m]
_ITERATIONS = 4  # place and heading of the arrival depend on each other
_DETOURS = (0.4, -0.4, 0.8, -0.8)  # drives straight on or back before a turn that is barred [m]
_DETOUR_FROM = 0.3  # distance from the goal under which none is made: it would dance there [m]
_DEEPER = 0.005  # by which an obstacle must come nearer than touching to bar the way [m]
_TURNED = 0.15  # turn that is still to come where the way is barred [rad]


@dataclass(frozen=True)
class Route:
    """Where a base will have carried what is tracked, beside its goal.

    Attributes:
        times: Times from now [s]. Shape (n,).
        offsets: Where it is carried, less the goal, by more than the torso bridges [m].
            Shape (n, 2).
        headings: Heading of the base, not wrapped [rad]. Shape (n,).
        turns: How far the frame is to be turned from its goal about the vertical, since the waist
            has to go round by its front; 0 once it can be at its goal [rad]. Shape (n,).
        share: How much that heading counts, from 0 at the goal to 1 away from it.
    """

    times: np.ndarray
    offsets: np.ndarray
    headings: np.ndarray
    turns: np.ndarray
    share: float

    def turns_at(self, ahead: np.ndarray) -> np.ndarray:
        """Turns from the goal at times from now [s]. (n,) -> (n,)."""
        return np.interp(ahead, self.times, self.turns)

    def offsets_at(self, ahead: np.ndarray) -> np.ndarray:
        """Offsets from the goal at times from now [s], the outermost beyond. (n,) -> (n, 2)."""
        columns = [np.interp(ahead, self.times, column) for column in self.offsets.T]
        return np.stack(columns, axis=-1)

    def facing_at(self, ahead: float) -> np.ndarray:
        """Direction of the base in `ahead` [s], as long as it counts. Shape (2,)."""
        heading = float(np.interp(ahead, self.times, self.headings))
        return self.share * np.array([math.cos(heading), math.sin(heading)])


class _Aim(NamedTuple):
    """What is to be carried where, and how it sits on the axle.

    Attributes:
        x: Place of the goal [m].
        y: The same.
        look: Where it looks [rad].
        twist: Largest twist of the waist in which the base may arrive [rad].
        waist: Place of what the waist turns about, in the base's frame, from the axle [m].
        ahead: How far ahead of that the tracked frame is, wherever it looks [m].
        driving: How the base drives.
    """

    x: float
    y: float
    look: float
    twist: float
    waist: tuple[float, float]
    ahead: float
    driving: Driving

    def clip(self, heading: float) -> float:
        """The heading nearest to `heading` in which the base may arrive [rad]."""
        return self.look + min(max(_wrap(heading - self.look), -self.twist), self.twist)

    def find_way(self, x: float, y: float, heading: float) -> tuple[float, float]:
        """From the axle at x, y to its place under the goal, arriving in `heading` [m]."""
        waist, head = _rotate(*self.waist, heading), _rotate(self.ahead, 0.0, self.look)
        return self.x - waist[0] - head[0] - x, self.y - waist[1] - head[1] - y


class RoutePlanner:
    r"""Simulates how a base with two wheels drives to its goal as fast as its limits allow.

    The axle's place p* depends on the heading ψ* in which the base arrives, and on where the goal
    looks, since a head sits ahead of its waist's axis. A waist that turns leaves ψ* free by
    `Driving.arrival_twist` on either side of where the goal looks, so that the base mostly need
    not turn again once it is there. It turns towards :math:`\pm(p^* - p)`, forwards or backwards,
    whatever costs less of a turn and of a twist, by the braking law
    :math:`\omega = \sqrt{2\alpha|e|}`, and drives by the same law as far as it faces its way,
    :math:`v = \cos^4 e\,\sqrt{2 b d}`. Both depend on the present state alone, so that a way
    that is computed anew goes on as before.

    Beside a wall a turn may be barred. The base then drives straight on or back first, the
    shortest drive after which it can turn.

    Far from its goal a robot on wheels does better to turn away from it first. No horizon of a
    third of a second shows that: the way is what its goals are led along.

    Args:
        morphology: The robot.
        resting: How far ahead of the base each tracked frame is at rest [m].
        footprint: Tells how near the base comes to obstacles; None: there are none.
        waist: How far ahead of the base is what the waist turns about [m].

    References:
        Siciliano et al., Robotics, 2009, section 11.5 (limits of feedback to a point for a
        unicycle) and 11.6 (regulation of the posture by turning and driving).
    """

    def __init__(
        self,
        morphology: Morphology,
        resting: Mapping[str, float],
        footprint: Footprint | None = None,
        waist: float = 0.0,
    ) -> None:
        self._footprint, self._waist = footprint, waist
        self._pivot, self._resting = morphology.pivot, dict(resting)
        assert morphology.driving is not None, f"how {morphology.name} drives is not known"
        self._driving = morphology.driving
        self._hands = {arm.frame for arm in morphology.arms}

    def plan(
        self,
        qpos: np.ndarray,
        speeds: tuple[float, float],
        name: str,
        pose: np.ndarray,
        goal: np.ndarray,
        duration: float,
        turn_rate: float = 0.0,
        ahead: float | None = None,
    ) -> Route:
        """Simulate the way.

        Args:
            qpos: Configuration now. Shape (nq,).
            speeds: Speed and yaw rate being commanded now [m/s], [rad/s].
            name: The tracked frame; a hand looks nowhere: the base then arrives as it faces now.
            pose: Pose of the frame now. Shape (7,).
            goal: Its goal, which stands still. Shape (7,).
            duration: Length of the way to look at [s].
            turn_rate: Yaw rate of the goal; behind one that turns the base does not wait until
                the waist is at its limit [rad/s].
            ahead: How far ahead of the base it will be, where not as at rest [m].
        """
        drive, heading = self._driving, float(quat_yaw(qpos[3:7]))
        x = float(qpos[0]) + self._pivot * math.cos(heading)
        y = float(qpos[1]) + self._pivot * math.sin(heading)
        gx, gy = float(goal[0]), float(goal[1])
        if name in self._hands:
            carried = _rotate(float(pose[0]) - x, float(pose[1]) - y, -heading)
            aim = _Aim(gx, gy, heading, 0.0, carried, 0.0, drive)
        else:
            resting = self._resting[name] if ahead is None else ahead
            waist = (self._waist - self._pivot, 0.0)
            turning = min(max((abs(turn_rate) - _RESTING) / (_TURNING - _RESTING), 0.0), 1.0)
            most = drive.arrival_twist
            twist = most + turning * (drive.turning_twist - most)
            look = float(compute_heading(goal[3:]))
            aim = _Aim(gx, gy, look, twist, waist, resting - self._waist, drive)
        count = math.ceil(duration / _DT) + 1
        way = _simulate(aim, x, y, heading, speeds, count)
        if self._footprint is not None and math.dist(way[0, :2], (gx, gy)) > _DETOUR_FROM:
            way = self._find_free(way, aim, speeds)
        turns = np.zeros(count)
        if name not in self._hands:
            twist = float(compute_heading(pose[3:])) - heading
            turns = _unwind(twist, aim.look, way[:, 2], drive.waist, drive.waist_speed)
        offsets = way[:, :2] - (gx, gy) + _turn(aim.waist, way[:, 2])
        offsets += _turn((aim.ahead, 0.0), aim.look + turns)
        far = np.hypot(offsets[:, 0], offsets[:, 1])
        offsets *= np.maximum(0.0, 1 - drive.lean / np.maximum(far, drive.lean))[:, None]
        twisted = abs(_wrap(aim.look - heading)) - (aim.twist or math.pi)
        share = max(float(far[0]) / drive.lean - 1.0, twisted / _TWIST_RAMP)
        share = min(max(share, 0.0), 1.0)
        return Route(np.arange(count) * _DT, offsets, way[:, 2], turns, share)

    def _find_free(self, way: np.ndarray, aim: _Aim, speeds: tuple[float, float]) -> np.ndarray:
        """The way itself, or one with a detour where its turn is barred. Shape (n, 3)."""
        footprint = self._footprint
        assert footprint is not None

        def find_bar(candidate: np.ndarray) -> int | None:
            clearance = footprint.compute_clearance(candidate[:, :2], candidate[:, 2])
            bars = np.flatnonzero(clearance < min(clearance[0], 0.0) - _DEEPER)
            return int(bars[0]) if len(bars) else None

        bar = find_bar(way)
        if bar is None or abs(way[-1, 2] - way[bar, 2]) < _TURNED:
            return way
        x, y, heading = (float(each) for each in way[0])
        for detour in _DETOURS:
            other = _simulate(aim, x, y, heading, speeds, len(way), detour)
            if find_bar(other) is None:
                return other
        return way


def _simulate(
    aim: _Aim,
    x: float,
    y: float,
    heading: float,
    speeds: tuple[float, float],
    count: int,
    detour: float = 0.0,
) -> np.ndarray:
    """The axle's places and headings, `detour` [m] straight first. Shape (count, 3)."""
    (v, w), way, left = speeds, np.empty((count, 3)), abs(detour)
    for i in range(count):
        way[i] = x, y, heading
        if left > 0:
            wanted_v, wanted_w = math.copysign(aim.driving.detour_speed, detour), 0.0
            left -= abs(v) * _DT
        else:
            wanted_v, wanted_w = _steer(aim, x, y, heading)
        v += _clamp(wanted_v - v, aim.driving.acceleration * _DT)
        w += _clamp(wanted_w - w, aim.driving.turn_acceleration * _DT)
        dx, dy = _rotate(v * _DT, 0.0, heading + w * _DT / 2)
        x, y, heading = x + dx, y + dy, heading + w * _DT
    return way


def _unwind(
    twist: float, look: float, headings: np.ndarray, limit: float, speed: float
) -> np.ndarray:
    """Turns of the head from where its goal looks, as the waist gets there by its front [rad].

    A waist at its limit on one side, whose goal is just beyond that of the other, has to go all
    the way back; the shortest turn of the head is barred. Shape (n,).
    """
    twist, turns = _clamp(_wrap(twist), limit), np.empty(len(headings))
    for i, heading in enumerate(headings):
        wanted = _wrap(look - heading)
        if abs(wanted) > limit:  # out of reach on either side: wait on this one
            wanted = math.copysign(limit, twist)
        if i:
            twist += _clamp(wanted - twist, speed * _DT)
        turns[i] = _wrap(heading + twist - look)
    return turns


def _steer(aim: _Aim, x: float, y: float, heading: float) -> tuple[float, float]:
    """Speed and yaw rate that are wanted of the axle at x, y [m/s], [rad/s]."""
    end = aim.clip(heading)
    dx, dy = aim.find_way(x, y, end)
    turn = _wrap(end - heading)
    must_turn = aim.twist > 0 and abs(turn) > _MUST_TURN
    if math.hypot(dx, dy) >= (_CLOSE_TURNING if must_turn else _CLOSE):
        turn, dx, dy = min(
            (_face(aim, x, y, heading, sign) for sign in (1.0, -1.0)), key=lambda way: way[0]
        )[1:]
    along, drive = dx * math.cos(heading) + dy * math.sin(heading), aim.driving
    v = _brake(along, drive.braking, _FINE_DRIVE) * max(0.0, math.cos(turn)) ** 4
    w = _clamp(_brake(turn, drive.turn_braking, _FINE_TURN), drive.turn)
    return _clamp(v, min(drive.speed, drive.centripetal / max(abs(w), 1e-6))), w


def _face(
    aim: _Aim, x: float, y: float, heading: float, sign: float
) -> tuple[float, float, float, float]:
    """Effort of driving forwards (1) or backwards (-1), the turn before, and the way [m]."""
    facing, end, dx, dy = heading, heading, 0.0, 0.0
    for _ in range(_ITERATIONS):
        end = aim.clip(facing)
        dx, dy = aim.find_way(x, y, end)
        ahead, aside = _rotate(_LINE_UP, 0.0, end)
        facing = math.atan2(sign * dy + aside, sign * dx + ahead)
    turn = _wrap(facing - heading)
    effort = abs(turn) + abs(_wrap(end - facing)) + _TWIST * abs(_wrap(end - aim.look))
    return effort + (_BACKWARDS if sign < 0 else 0.0), turn, dx, dy


def _brake(distance: float, deceleration: float, fine: float) -> float:
    """The largest speed from which `distance` is enough to stop, gentle at its end."""
    if abs(distance) < fine:
        return _FINE * distance
    return math.copysign(math.sqrt(2 * deceleration * abs(distance)), distance)


def _clamp(value: float, largest: float) -> float:
    return min(max(value, -largest), largest)


def _rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


def _turn(place: tuple[float, float], headings: np.ndarray) -> np.ndarray:
    """A place in frames of several headings. (2,), (n,) -> (n, 2)."""
    cosine, sine = np.cos(headings), np.sin(headings)
    return np.stack(
        [cosine * place[0] - sine * place[1], sine * place[0] + cosine * place[1]], axis=-1
    )


def _wrap(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))
