"""Support cost: a robot that cannot step must not tip over."""

from __future__ import annotations

import numpy as np

from xop_lerobot.core.transforms import quat_yaw, sum_squares
from xop_lerobot.retarget.costs.cost import Cost, Evaluation
from xop_lerobot.retarget.static_load import StaticLoad

GRAVITY = 9.81
_VELOCITY_STEPS = 3  # control steps at the end of the horizon that give the velocity


class SupportArea:
    """The area on which a robot stands, shrunk by a margin.

    Args:
        corners: Corners (x, y) in the base's frame, counterclockwise [m]. Shape (c, 2).
        resting: Where the centre of mass is at rest, in the base's frame [m]. Shape (2,).
        margin: Distance that is kept from every edge [m].
        free: Distance from rest up to which a lean costs nothing: arms reach, chests bend [m].
    """

    def __init__(
        self,
        corners: tuple[tuple[float, float], ...],
        resting: tuple[float, float] = (0.0, 0.0),
        margin: float = 0.1,
        free: float = 0.05,
    ) -> None:
        points = np.array(corners, dtype=float)
        edges = np.roll(points, -1, axis=0) - points
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)  # outwards
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        self._offsets = (self._normals * points).sum(1) - margin
        self._resting = np.array(resting)
        self._free = free

    def compute_excess(self, base: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Distances of points beyond each edge, 0 inside [m]. (..., 7), (..., 2) -> (..., c)."""
        return self.compute_excess_in_base(_to_base(base, points))

    def compute_excess_in_base(self, places: np.ndarray) -> np.ndarray:
        """`compute_excess` of places in the base's frame [m]. (..., 2) -> (..., c)."""
        return np.maximum(places @ self._normals.T - self._offsets, 0)

    def compute_lean(
        self, base: np.ndarray, com: np.ndarray, balance: np.ndarray | None = None
    ) -> np.ndarray:
        """Place of the centre of mass beyond the free circle about where it rests [m].

        That is `balance`, shape (2,), or where it rests as the robot stands.

        Shapes (..., 7), (..., 2) -> (..., 2).
        """
        offset = _to_base(base, com) - (self._resting if balance is None else balance)
        length = np.sqrt(sum_squares(offset))
        share = np.maximum(0, 1 - self._free / np.maximum(length, 1e-9))
        return offset * share[..., None]

    def linearise_excess(
        self, base: np.ndarray, point: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`compute_excess` of one point, and its derivative by the place in the base's frame.

        Shapes (7,), (2,) -> (c,), (c, 2).
        """
        excess = self._normals @ _to_base(base, point) - self._offsets
        outside = excess > 0
        return np.where(outside, excess, 0.0), self._normals * outside[:, None]

    def linearise_lean(
        self, base: np.ndarray, com: np.ndarray, balance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`compute_lean` of one place, and its derivative by the place in the base's frame.

        Shapes (7,), (2,) -> (2,), (2, 2).
        """
        offset = _to_base(base, com) - (self._resting if balance is None else balance)
        length = float(np.linalg.norm(offset))
        if length <= self._free:
            return np.zeros(2), np.zeros((2, 2))
        along = offset / length
        share = 1 - self._free / length
        # Radially the length beyond the circle changes, across only the direction does.
        return offset * share, share * np.eye(2) + (1 - share) * np.outer(along, along)


def _to_base(base: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points in the base's place and heading. (..., 7), (..., 2) -> (..., 2)."""
    yaw = quat_yaw(base[..., 3:])
    dx, dy = points[..., 0] - base[..., 0], points[..., 1] - base[..., 1]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)


class SupportCost(Cost):
    r"""Squared distances beyond the shrunk support area, of three points.

    .. math::

        z = c_{xy} - \frac{c_z}{g}\,\ddot c_{xy}, \qquad
        \xi = c_{xy} + \sqrt{c_z / g}\;\dot c_{xy}

    with c the centre of mass and its acceleration the mean over the horizon, from finite
    differences. On flat ground the robot tips where the zero-moment point z leaves the area
    (Vukobratović and Borovac, 2004). The horizon is too short to see a tipping that has begun:
    ξ, at its end and with the velocity relative to the base, is where the centre of mass would
    come to rest over a pivot if all joints stopped (the capture point; Pratt et al., 2006).
    The third is the centre of mass itself at the end of the extrapolation, where the robot shall
    be able to stand still. There its squared distance beyond a free circle about where it rests
    counts too, with the weight `lean`: a mobile robot shall drive after its goal, not bend; and
    the static torques there beyond their share of what motors can, squared, with the weight
    `load`: a torso whose servos give way folds. The paper has no such term.

    Args:
        area: The support area, None for a robot whose policy keeps the balance.
        load: What joints bear of the weight above them; None where that does not count.
    """

    name = "support"

    def __init__(self, area: SupportArea | None, load: StaticLoad | None = None) -> None:
        self.area, self.load = area, load

    def compute(self, evaluation: Evaluation) -> np.ndarray:
        """Cost of every sample. Shape (K,)."""
        loaded = np.zeros(len(evaluation.qpos))
        if self.load is not None:
            beyond = self.load.compute_excess(evaluation.terminal_qpos)
            loaded = evaluation.weights.load * sum_squares(beyond)
        if self.area is None:
            return loaded
        com, dt = evaluation.com[:, 1:], evaluation.dt
        velocity = np.diff(com[..., :2], axis=1) / dt
        acceleration = np.zeros((len(com), 2))  # two steps or less do not tell
        if velocity.shape[1] > 1:
            span = (velocity.shape[1] - 1) * dt
            acceleration = (velocity[:, -1] - velocity[:, 0]) / span
        zmp = com[..., :2] - com[..., 2:] / GRAVITY * acceleration[:, None]
        excess = sum_squares(self.area.compute_excess(evaluation.qpos[:, 1:, :7], zmp))
        excess = excess.mean(-1) + sum_squares(self._compute_capture_excess(evaluation))
        base, com = evaluation.terminal_qpos[:, :7], evaluation.terminal_com[:, :2]
        excess += sum_squares(self.area.compute_excess(base, com))
        lean = sum_squares(self.area.compute_lean(base, com, evaluation.balance))
        return evaluation.weights.support * excess + evaluation.weights.lean * lean + loaded

    def _compute_capture_excess(self, evaluation: Evaluation) -> np.ndarray:
        """Distances of the capture point beyond each edge at the end of the horizon. (K, c)."""
        assert self.area is not None
        steps = min(_VELOCITY_STEPS, evaluation.com.shape[1] - 1)
        com, base = evaluation.com[:, -1 - steps :], evaluation.qpos[:, -1 - steps :, :7]
        place = _to_base(base, com[..., :2])
        velocity = (place[:, -1] - place[:, 0]) / (steps * evaluation.dt)
        capture = place[:, -1] + np.sqrt(np.maximum(com[:, -1, 2:], 0) / GRAVITY) * velocity
        return self.area.compute_excess_in_base(capture)
