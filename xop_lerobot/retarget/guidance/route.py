"""Path of a nonholonomic base to a stationary goal: turn, drive, arrive.

`RoutePlanner.plan` simulates the path with a feedback law and returns it as a `Route`; `Footprint`
gives the clearance of the base along a path.
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
from xop_lerobot.retarget.costs.balance import BACKWARDS_COST, TWIST_COST
from xop_lerobot.retarget.obstacles import Obstacle, ObstacleSet


class Footprint:
    """Hull spheres that are attached to the base, and their distance to obstacles.

    Args:
        morphology: The robot.
        model: Its planning model.
        obstacles: Obstacles around the robot.
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
        """Replace the obstacles."""
        self._obstacles = ObstacleSet(obstacles)

    def compute_clearance(self, axle: np.ndarray, headings: np.ndarray) -> np.ndarray:
        """Distance of the base to the nearest obstacle, negative inside; infinite without any [m].

        Args:
            axle: Positions of the middle of the axle [m]. Shape (n, 2).
            headings: Headings of the base [rad]. Shape (n,).

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


_DT = 0.04  # time step of the simulated path [s]
_FINE = 6.0  # proportional gain near the goal, where the braking law is too steep [1/s]
_FINE_DRIVE, _FINE_TURN = 0.05, 0.1  # distances within which that gain applies [m], [rad]
_RESTING, _TURNING = 0.15, 0.45  # yaw rates of a goal at rest and of a turning one [rad/s]
_TWIST_RAMP = 0.3  # excess twist over which the weight of the heading grows to 1 [rad]
_CLOSE = 0.12  # distance from its goal position at which the axle no longer turns towards it [m]
_MUST_TURN = 0.05  # turn into the waist's range from which that turn has priority [rad]
_CLOSE_TURNING = 0.35  # `_CLOSE` during such a turn, which displaces the head [m]
_LINE_UP = 0.2  # distance at which arrival heading and direction of the path weigh the same [m]
_ITERATIONS = 4  # fixed-point iterations: position and heading at arrival depend on each other
_DETOURS = (0.4, -0.4, 0.8, -0.8)  # straight drives before a blocked turn, shortest first [m]
_DETOUR_FROM = 0.3  # distance to the goal below which no detour is made, to avoid dithering [m]
_DEEPER = 0.005  # penetration of an obstacle from which it blocks the path [m]
_TURNED = 0.15  # remaining turn where the path is blocked from which a detour can help [rad]


@dataclass(frozen=True)
class Route:
    """Path of a base, as offsets of the tracked frame from its goal.

    Attributes:
        times: Times from now [s]. Shape (n,).
        offsets: Horizontal offset of the tracked frame from its goal, beyond what the torso can
            bridge [m]. Shape (n, 2).
        headings: Heading of the base, not wrapped [rad]. Shape (n,).
        turns: Heading of the tracked frame relative to its goal while the waist turns round by
            its front; 0 once the goal is within its range [rad]. Shape (n,).
        share: Weight of `headings`, from 0 at the goal to 1 away from it.
    """

    times: np.ndarray
    offsets: np.ndarray
    headings: np.ndarray
    turns: np.ndarray
    share: float

    def turns_at(self, ahead: np.ndarray) -> np.ndarray:
        """Interpolate `turns` at times from now [s]. (n,) -> (n,)."""
        return np.interp(ahead, self.times, self.turns)

    def offsets_at(self, ahead: np.ndarray) -> np.ndarray:
        """Interpolate `offsets` at times from now [s], clamped at the ends. (n,) -> (n, 2)."""
        columns = [np.interp(ahead, self.times, column) for column in self.offsets.T]
        return np.stack(columns, axis=-1)

    def facing_at(self, ahead: float) -> np.ndarray:
        """Heading in `ahead` [s] as a direction whose length is its weight. Shape (2,)."""
        heading = float(np.interp(ahead, self.times, self.headings))
        return self.share * np.array([math.cos(heading), math.sin(heading)])


class _Aim(NamedTuple):
    """Goal of the tracked frame, and the geometry between the frame and the axle.

    Attributes:
        x: Goal position x [m].
        y: Goal position y [m].
        look: Heading of the goal [rad].
        twist: Largest waist twist at arrival [rad].
        waist: Position of the waist's axis relative to the axle, in the base's frame [m].
        ahead: Distance of the tracked frame from the waist's axis, along its heading [m].
        driving: Limits and gains of the base.
    """

    x: float
    y: float
    look: float
    twist: float
    waist: tuple[float, float]
    ahead: float
    driving: Driving

    def clip(self, heading: float) -> float:
        """The allowed arrival heading closest to `heading` [rad]."""
        return self.look + min(max(_wrap(heading - self.look), -self.twist), self.twist)

    def find_path(self, x: float, y: float, heading: float) -> tuple[float, float]:
        """Vector from the axle at x, y to its position on arrival with `heading` [m]."""
        waist, head = _rotate(*self.waist, heading), _rotate(self.ahead, 0.0, self.look)
        return self.x - waist[0] - head[0] - x, self.y - waist[1] - head[1] - y


class RoutePlanner:
    r"""Simulates how a differential-drive base reaches its goal within its limits.

    The position p* of the axle at arrival depends on the arrival heading ψ* of the base and on
    the heading of the goal, since a head sits ahead of its waist's axis. The waist leaves ψ* free
    by `Driving.arrival_twist` on either side of the goal's heading, so that the base mostly need
    not turn again on arrival. The base turns towards :math:`\pm(p^* - p)`, forwards or backwards,
    whichever needs less turn and twist, by the braking law :math:`\omega = \sqrt{2\alpha|e|}`. It
    drives by the same law, as far as it faces its path, :math:`v = \cos^4 e\,\sqrt{2 b d}`. Both
    depend on the present state alone, so a recomputed path continues the previous one.

    Beside a wall a turn may be blocked. The base then first drives straight on or back, by the
    shortest distance after which it can turn.

    A wheeled robot may have to turn away from a goal at its side first, which a horizon of a third
    of a second does not show. So the simulated path is the reference of the planner.

    Args:
        morphology: The robot.
        resting: Forward distance of each tracked frame from the base at rest [m].
        footprint: Clearance of the base from obstacles; None without obstacles.
        waist: Forward distance of the waist's axis from the base [m].

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
        assert morphology.driving is not None, f"{morphology.name} has no driving parameters"
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
        """Simulate the path.

        Args:
            qpos: Present configuration. Shape (nq,).
            speeds: Commanded speed and yaw rate [m/s], [rad/s].
            name: The tracked frame. A hand has no gaze direction: the base keeps its heading.
            pose: Present pose of the frame. Shape (7,).
            goal: Its stationary goal. Shape (7,).
            duration: Duration of the path [s].
            turn_rate: Yaw rate of the goal; the faster it turns, the sooner the base turns after
                it, before the waist reaches its limit [rad/s].
            ahead: Forward distance of the frame from the base at the goal; by default that at
                rest [m].
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
        path = _simulate(aim, x, y, heading, speeds, count)
        if self._footprint is not None and math.dist(path[0, :2], (gx, gy)) > _DETOUR_FROM:
            path = self._find_free(path, aim, speeds)
        turns = np.zeros(count)
        if name not in self._hands:
            twist = float(compute_heading(pose[3:])) - heading
            turns = _unwind(twist, aim.look, path[:, 2], drive.waist, drive.waist_speed)
        offsets = path[:, :2] - (gx, gy) + _turn(aim.waist, path[:, 2])
        offsets += _turn((aim.ahead, 0.0), aim.look + turns)
        far = np.hypot(offsets[:, 0], offsets[:, 1])
        offsets *= np.maximum(0.0, 1 - drive.lean / np.maximum(far, drive.lean))[:, None]
        twisted = abs(_wrap(aim.look - heading)) - (aim.twist or math.pi)
        share = max(float(far[0]) / drive.lean - 1.0, twisted / _TWIST_RAMP)
        share = min(max(share, 0.0), 1.0)
        return Route(np.arange(count) * _DT, offsets, path[:, 2], turns, share)

    def _find_free(self, path: np.ndarray, aim: _Aim, speeds: tuple[float, float]) -> np.ndarray:
        """Return the path, or one with a detour if a turn on it is blocked. Shape (n, 3)."""
        footprint = self._footprint
        assert footprint is not None

        def find_block(candidate: np.ndarray) -> int | None:
            clearance = footprint.compute_clearance(candidate[:, :2], candidate[:, 2])
            blocks = np.flatnonzero(clearance < min(clearance[0], 0.0) - _DEEPER)
            return int(blocks[0]) if len(blocks) else None

        block = find_block(path)
        if block is None or abs(path[-1, 2] - path[block, 2]) < _TURNED:
            return path
        x, y, heading = (float(each) for each in path[0])
        for detour in _DETOURS:
            other = _simulate(aim, x, y, heading, speeds, len(path), detour)
            if find_block(other) is None:
                return other
        return path


def _simulate(
    aim: _Aim,
    x: float,
    y: float,
    heading: float,
    speeds: tuple[float, float],
    count: int,
    detour: float = 0.0,
) -> np.ndarray:
    """Positions and headings of the axle, after `detour` [m] straight on. Shape (count, 3)."""
    (v, w), path, left = speeds, np.empty((count, 3)), abs(detour)
    for i in range(count):
        path[i] = x, y, heading
        if left > 0:
            wanted_v, wanted_w = math.copysign(aim.driving.detour_speed, detour), 0.0
            left -= abs(v) * _DT
        else:
            wanted_v, wanted_w = _steer(aim, x, y, heading)
        v += _clamp(wanted_v - v, aim.driving.acceleration * _DT)
        w += _clamp(wanted_w - w, aim.driving.turn_acceleration * _DT)
        dx, dy = _rotate(v * _DT, 0.0, heading + w * _DT / 2)
        x, y, heading = x + dx, y + dy, heading + w * _DT
    return path


def _unwind(
    twist: float, look: float, headings: np.ndarray, limit: float, speed: float
) -> np.ndarray:
    """Headings of the head relative to its goal while the waist turns within its range [rad].

    From its limit on one side to a goal just beyond the limit on the other side, the waist has to
    turn all the way back; the shorter turn is mechanically impossible. Shape (n,).
    """
    twist, turns = _clamp(_wrap(twist), limit), np.empty(len(headings))
    for i, heading in enumerate(headings):
        wanted = _wrap(look - heading)
        if abs(wanted) > limit:  # out of range on either side: wait at the limit of this one
            wanted = math.copysign(limit, twist)
        if i:
            twist += _clamp(wanted - twist, speed * _DT)
        turns[i] = _wrap(heading + twist - look)
    return turns


def _steer(aim: _Aim, x: float, y: float, heading: float) -> tuple[float, float]:
    """Desired speed and yaw rate of the axle at x, y [m/s], [rad/s]."""
    end = aim.clip(heading)
    dx, dy = aim.find_path(x, y, end)
    turn = _wrap(end - heading)
    must_turn = aim.twist > 0 and abs(turn) > _MUST_TURN
    if math.hypot(dx, dy) >= (_CLOSE_TURNING if must_turn else _CLOSE):
        turn, dx, dy = min(
            (_face(aim, x, y, heading, sign) for sign in (1.0, -1.0)), key=lambda path: path[0]
        )[1:]
    along, drive = dx * math.cos(heading) + dy * math.sin(heading), aim.driving
    v = _brake(along, drive.braking, _FINE_DRIVE) * max(0.0, math.cos(turn)) ** 4
    w = _clamp(_brake(turn, drive.turn_braking, _FINE_TURN), drive.turn)
    return _clamp(v, min(drive.speed, drive.centripetal / max(abs(w), 1e-6))), w


def _face(
    aim: _Aim, x: float, y: float, heading: float, sign: float
) -> tuple[float, float, float, float]:
    """Effort of driving forwards (1) or backwards (-1), the turn before it, and the path [m]."""
    facing, end, dx, dy = heading, heading, 0.0, 0.0
    for _ in range(_ITERATIONS):
        end = aim.clip(facing)
        dx, dy = aim.find_path(x, y, end)
        ahead, aside = _rotate(_LINE_UP, 0.0, end)
        facing = math.atan2(sign * dy + aside, sign * dx + ahead)
    turn = _wrap(facing - heading)
    effort = abs(turn) + abs(_wrap(end - facing)) + TWIST_COST * abs(_wrap(end - aim.look))
    return effort + (BACKWARDS_COST if sign < 0 else 0.0), turn, dx, dy


def _brake(distance: float, deceleration: float, fine: float) -> float:
    """Largest speed from which a stop within `distance` is possible, linear near its end."""
    if abs(distance) < fine:
        return _FINE * distance
    return math.copysign(math.sqrt(2 * deceleration * abs(distance)), distance)


def _clamp(value: float, largest: float) -> float:
    return min(max(value, -largest), largest)


def _rotate(x: float, y: float, angle: float) -> tuple[float, float]:
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


def _turn(place: tuple[float, float], headings: np.ndarray) -> np.ndarray:
    """Rotate a vector by several headings. (2,), (n,) -> (n, 2)."""
    cosine, sine = np.cos(headings), np.sin(headings)
    return np.stack(
        [cosine * place[0] - sine * place[1], sine * place[0] + cosine * place[1]], axis=-1
    )


def _wrap(angle: float) -> float:
    return math.atan2(math.sin(angle), math.cos(angle))
