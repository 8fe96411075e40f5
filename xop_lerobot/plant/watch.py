"""Detection of unintended motion: moving while commanded to stand, or servos that give way."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode, RobotAction
from xop_lerobot.core.transforms import quat_yaw
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.effect import Acts
from xop_lerobot.morphology.morphology import Morphology

MOVES = "the robot moves though it is told to stand"
GIVES_WAY = "the robot's servos give way under the load"

STRAY = 0.08
"""Largest displacement of a foot or wheel of a robot that is commanded to stand [m]."""
STEP = 0.10
"""Largest displacement of the feet relative to each other [m]."""
SETTLE_S = 1.0
"""Time allowed from the command to stand until the robot stands, for its last step [s]."""
STRAY_LAG_S = 0.2
"""Time constant of the low-pass filter of positions, which have the noise of the odometry [s]."""
STEP_LAG_S = 0.04
"""The same for positions relative to each other, which encoders measure more accurately [s]."""
CREEP = 0.01
"""Drift of the position estimate that does not count as motion [m/s]."""
STILL = 0.1
"""Velocity command below which a robot in mobile mode is meant to stand [m/s or rad/s]."""
SPEED = 0.3
"""Mean speed that counts as motion in mobile mode [m/s]; policies step in place and drift a bit."""
SPAN_S = 0.5
"""Averaging time of that speed [s]."""
GAP_S = 0.3
"""Time for which a tracking error may exceed `Servos.gap` [s]."""
CALM_S = 1.0
"""Time without an anomaly after which `trouble` is cleared [s]."""


def find_load_bearing(
    morphology: Morphology, model: mujoco.MjModel
) -> tuple[np.ndarray, np.ndarray]:
    """Find the joints of the posture, which carry the upper body.

    A joint that moves alone, such as a neck's, carries little, and lags far behind quick targets.

    Returns:
        Their columns in the command, and their addresses in qpos. Shapes (n,), int.
    """
    joints = [
        (column, int(model.joint(effect.joint).qposadr[0]))
        for column, (effect, dim) in enumerate(
            zip(morphology.effects, morphology.command_space.dims, strict=True)
        )
        if effect.acts is Acts.JOINT and not dim.alone
    ]
    columns, addresses = np.array(joints, dtype=int).reshape(-1, 2).T
    return columns, addresses


class Watch:
    """Monitors a robot for motion that the operator did not command, once per policy period.

    *It moves while commanded to stand.* In stationary mode, from one second after the last
    velocity command, feet or wheels must stay in place. In mobile mode, where policies step in
    place, the base must not move fast while the velocity commands are about zero. The reference
    position slowly follows the estimate, so that drift of the odometry raises no alarm.

    *Its servos give way.* A body joint of the posture whose tracking error exceeds `Servos.gap`
    carries more than its motor can.

    Args:
        morphology: The robot.
    """

    def __init__(self, morphology: Morphology) -> None:
        self._space = morphology.command_space
        self._model = morphology.build_spec("planning").compile()
        self._data = mujoco.MjData(self._model)
        self._points = [self._model.site(point).id for point in morphology.contact_points]
        acts = [effect.acts for effect in morphology.effects]
        self._velocities = np.array(
            [each in (Acts.FORWARD, Acts.LEFT, Acts.TURN) for each in acts], dtype=bool
        )
        self._columns, self._addresses = find_load_bearing(morphology, self._model)
        self._gap_limit = morphology.servos.gap if morphology.servos else math.inf
        self.reset()

    def reset(self) -> None:
        """Restart the monitor, after the robot was reset."""
        self.trouble = ""
        """The anomaly as a text; empty for none."""
        self._mode: Mode | None = None
        self._stood = self._gap = self._calm = 0.0
        self._places: np.ndarray | None = None
        self._home = self._spread = self._spread_home = np.zeros((0, 2))
        self._track: list[np.ndarray] = []

    def update(self, qpos: np.ndarray, action: RobotAction) -> None:
        """Check the robot after a period of its policy.

        Args:
            qpos: Measured position of the robot. Shape (nq,).
            action: The executed action.
        """
        found = GIVES_WAY if self._gives_way(qpos, action) else ""
        if self._moves(qpos, action):
            found = found or MOVES
        if found:
            # A folding robot also moves; report the cause, not the consequence.
            self.trouble = found if found == GIVES_WAY else self.trouble or found
            self._calm = 0.0
            return
        self._calm += POLICY_DT
        if self._calm >= CALM_S:
            self.trouble = ""

    def _gives_way(self, qpos: np.ndarray, action: RobotAction) -> bool:
        gaps = np.abs(action.command[self._columns] - qpos[self._addresses])
        behind = gaps.max(initial=0.0) > self._gap_limit
        self._gap = self._gap + POLICY_DT if behind else 0.0
        return self._gap > GAP_S

    def _moves(self, qpos: np.ndarray, action: RobotAction) -> bool:
        if action.mode is not self._mode:
            self._mode = action.mode
            self._forget_place()
        velocity = (action.command - self._space.neutral)[self._velocities]
        if action.mode is Mode.STATIONARY:
            at_rest = np.abs(velocity) <= self._space.sway[self._velocities] + 1e-6
        else:
            at_rest = np.abs(velocity) <= STILL
        if not at_rest.all():
            self._forget_place()
            return False
        self._stood += POLICY_DT
        if self._stood < SETTLE_S:
            return False
        return self._strays(qpos) if action.mode is Mode.STATIONARY else self._runs(qpos)

    def _forget_place(self) -> None:
        self._stood, self._places = 0.0, None
        self._track.clear()

    def _strays(self, qpos: np.ndarray) -> bool:
        """Whether feet or wheels have moved since the first call after `_forget_place`."""
        places = self._find_places(qpos)
        spread = places - places[0]
        if self._places is None:
            self._places = self._home = places
            self._spread = self._spread_home = spread
        self._places = self._places + (places - self._places) * (POLICY_DT / STRAY_LAG_S)
        self._spread = self._spread + (spread - self._spread) * (POLICY_DT / STEP_LAG_S)
        stray = np.linalg.norm(self._places - self._home, axis=1)
        step = np.linalg.norm(self._spread - self._spread_home, axis=1)
        if stray.max() > STRAY or step.max() > STEP:
            self._home, self._spread_home = self._places, self._spread  # detect further motion
            return True
        follow = np.minimum(1.0, CREEP * POLICY_DT / np.maximum(stray, 1e-9))
        self._home = self._home + (self._places - self._home) * follow[:, None]
        return False

    def _find_places(self, qpos: np.ndarray) -> np.ndarray:
        """Horizontal positions of the contact points [m]. Shape (points, 2)."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[self._points, :2].copy()

    def _runs(self, qpos: np.ndarray) -> bool:
        """Whether the base has moved faster than `SPEED` on average over `SPAN_S`."""
        self._track.append(np.array([*qpos[:2], quat_yaw(qpos[None, 3:7])[0]]))
        if len(self._track) <= round(SPAN_S / POLICY_DT):
            return False
        moved = self._track[-1] - self._track.pop(0)
        turned = (moved[2] + np.pi) % (2 * np.pi) - np.pi
        return bool(np.hypot(*moved[:2]) > SPEED * SPAN_S or abs(turned) > 2 * SPEED * SPAN_S)
