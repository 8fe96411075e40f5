"""How far a waist can turn before an arm touches what is below it."""

from __future__ import annotations

from collections import deque

import mujoco
import numpy as np

from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology

_STEP, _FIRST = 0.1, 0.8  # angles that are tried, on either side [rad]
_SPARE = 0.2  # what is left free between the last free angle and the waist [rad]
_DEEP = 0.01  # by which arms are in the way, and no longer graze [m]
_SAME = 0.03  # a posture within which the last answer holds [rad]
_LASTING = 1.5  # time for which arms have to be in the way [s]
_NEAR = 0.2  # so near to its limit a waist is told of no more room [rad]
_UPRIGHT = 0.9  # cosine of a waist's axis to the vertical, from which on it stands upright


class TwistRoom:
    """Looks how far the waist may twist as the arms are now.

    Arms that hang at rest leave a waist all its range. Elbows that are tucked in, to hold
    something before the chest, meet hips and belly after a quarter turn: they are pushed aside,
    and what they hold is lost.

    Args:
        morphology: The robot; without a joint that turns its waist it has all the room.
    """

    def __init__(self, morphology: Morphology) -> None:
        self._model = morphology.build_spec("full").compile()
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:] = morphology.standing_qpos()
        mujoco.mj_kinematics(self._model, self._data)
        joints = [
            self._model.joint(effect.joint)
            for effect in morphology.effects
            if effect.acts is Acts.JOINT
        ]
        upright = [joint for joint in joints if self._data.xaxis[joint.id, 2] > _UPRIGHT]
        self._address = self._waist = -1
        if upright:
            waist = upright[-1]
            self._address, self._waist = int(waist.qposadr[0]), int(waist.bodyid[0])
            self._range = float(np.abs(waist.range).min())
            self._above = _find_subtree(self._model, self._waist)
        self.reset()

    def reset(self) -> None:
        """Start anew."""
        self._last, self._room = np.full(self._model.nq, np.inf), np.inf
        self._rooms: deque[tuple[float, float]] = deque()
        self._told = np.inf

    def compute(self, qpos: np.ndarray, time: float) -> float:
        """Largest twist to either side that leaves the arms free, 0.5 at the least [rad].

        Arms that swing past are not in the way: what counts is the most of the last seconds. And
        an arm that is being pushed aside makes no room.

        Args:
            qpos: Configuration now. Shape (nq,).
            time: Time of it [s].
        """
        if self._waist < 0:
            return np.inf
        posture = np.array(qpos)
        posture[:7] = posture[self._address] = 0.0
        if np.abs(posture - self._last).max() > _SAME:
            self._last, self._room = posture, self._search(np.array(qpos))
        self._rooms.append((time, self._room))
        while self._rooms[0][0] < time - _LASTING:
            self._rooms.popleft()
        most = max(room for _, room in self._rooms)
        if most < self._told or abs(qpos[self._address]) < self._told - _NEAR:
            self._told = most
        return self._told

    def _search(self, qpos: np.ndarray) -> float:
        for angle in np.arange(_FIRST, self._range, _STEP):
            for side in (1.0, -1.0):
                qpos[self._address] = side * angle
                if self._touches(qpos):
                    return float(angle) - _STEP - _SPARE
        return self._range

    def _touches(self, qpos: np.ndarray) -> bool:
        """Whether anything above the waist touches anything below."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        deep = data.contact.dist < -_DEEP
        above = self._above[model.geom_bodyid[data.contact.geom[deep]]]
        return bool((above[:, 0] != above[:, 1]).any())


def _find_subtree(model: mujoco.MjModel, root: int) -> np.ndarray:
    """Which bodies hang on `root`, itself among them. Shape (bodies,), bool."""
    above = np.zeros(model.nbody, dtype=bool)
    above[root] = True
    for body in range(root + 1, model.nbody):
        above[body] = above[model.body_parentid[body]]
    return above
