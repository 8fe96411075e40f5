"""Lock-step control loop of a robot: a low-level policy that closes the loop around a plant."""

from __future__ import annotations

import time

import numpy as np

from xop_lerobot.core.command import RobotAction
from xop_lerobot.core.errors import BadValue
from xop_lerobot.core.state import RobotState, freeze
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy
from xop_lerobot.morphology.limits import limit_action, round_action
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.plant.plant import Measurement, Plant
from xop_lerobot.plant.watch import Watch

# Measured base speed below which a robot is stationary [m/s]: five standard deviations of the noise
# per axis of the mild preset, so that noise does not make a standing robot seem to move.
_SETTLED_SPEED = 0.15


class PolicyLoop:
    """Runs the policy at 50 Hz in lock-step: time advances only in `execute` and `advance`.

    Args:
        morphology: The robot.
        plant: Its body; it adopts the motors that the policy was trained with.
        policy: Its low-level policy.

    Attributes:
        action: The action being executed.
    """

    def __init__(self, morphology: Morphology, plant: Plant, policy: LowLevelPolicy) -> None:
        morphology = morphology.fit(policy)
        self.morphology, self.plant, self.policy = morphology, plant, policy
        plant.adapt(policy)
        self._memory = policy.initial_memory(1)
        self.action = round_action(morphology.rest_action())
        self._previous: RobotAction | None = None  # action before the present one, in `execute`
        self._measurement: Measurement | None = None
        self._collision = self._was_read = False
        self._watch = Watch(morphology)

    @property
    def state(self) -> RobotState:
        """Measured state of the robot; the same value until time advances.

        Any contact since the state was last read counts as a collision, however short.
        """
        if self._measurement is None:
            self._measurement = self.plant.measure()
        self._was_read = True
        measured, action = self._measurement, self.action
        return RobotState(
            time=measured.time,
            qpos=freeze(measured.qpos),
            qvel=freeze(measured.qvel),
            memory=freeze(self._memory[0]),
            command=freeze(action.command),
            arms=freeze(action.arms),
            mode=action.mode,
            effort=freeze(measured.effort),
            true_qpos=freeze(measured.true_qpos),
            true_qvel=freeze(measured.true_qvel),
            wall_time=time.time(),
            fallen=measured.fallen,
            collision=self._collision or measured.collision,
            settled=bool(np.linalg.norm(measured.qvel[:3]) < _SETTLED_SPEED),
            trouble=self._watch.trouble,
        )

    def reset(
        self, seed: int | None = None, settle_s: float = 1.0, start: RobotAction | None = None
    ) -> None:
        """Reset the plant, and let the policy settle for `settle_s` [s].

        Args:
            seed: Seed of the plant.
            settle_s: Time to settle [s].
            start: Action to execute meanwhile; by default the action at rest.
        """
        self.plant.reset(seed)
        self._memory = self.policy.initial_memory(1)
        self.action = round_action(start or self.morphology.rest_action())
        self._measurement = None
        self.advance(settle_s)
        self._watch.reset()
        self._collision = self._was_read = False

    def execute(self, action: RobotAction, dt: float) -> RobotAction:
        """Limit `action`, execute it for `dt` [s], and return the executed action.

        Raises:
            BadValue: If `dt` is not a whole multiple of the policy's period.
        """
        self._previous = self.action
        self.action = self.limit(action, dt)
        try:
            self.advance(dt)
        finally:
            self._previous = None
        return self.action

    def limit(self, action: RobotAction, dt: float) -> RobotAction:
        """Limit `action` to what can be executed within `dt` [s] after the present action."""
        return limit_action(self.morphology, action, self.action, dt, self.policy.arm_limits)

    def advance(self, dt: float) -> None:
        """Advance by `dt` [s] under the present action.

        Raises:
            BadValue: If `dt` is not a whole multiple of the policy's period.
        """
        steps = round(dt / POLICY_DT)
        if abs(steps * POLICY_DT - dt) > 1e-9:
            raise BadValue(
                f"dt = {dt} s is not a whole multiple of the policy period {POLICY_DT} s"
            )
        if self._was_read:  # earlier contacts have been reported; otherwise keep them
            self._collision = self._was_read = False
        for i in range(steps):
            self._run_policy(self._find_action((i + 1) / steps))

    def _find_action(self, share: float) -> RobotAction:
        """Interpolated action of the period that ends at the fraction `share` of its duration."""
        action, previous = self.action, self._previous
        if not self.morphology.ramps or previous is None or previous.mode is not action.mode:
            return action
        return RobotAction(
            previous.command + share * (action.command - previous.command),
            action.mode,
            previous.arms + share * (action.arms - previous.arms),
        )

    def _run_policy(self, action: RobotAction) -> None:
        """Run one period of the policy: measure, act, advance by 20 ms."""
        measured = self._measurement or self.plant.measure()
        targets, self._memory = self.policy.act(
            measured.qpos[None],
            measured.qvel[None],
            action.command[None],
            action.arms[None],
            self._memory,
            action.mode,
        )
        if self.morphology.ramps:
            self.plant.ramp(targets[0])
        else:
            self.plant.apply(targets[0])
        self.plant.step(POLICY_DT)
        self._measurement = self.plant.measure()
        self._collision |= self._measurement.collision
        self._watch.update(self._measurement.qpos, action)

    def close(self) -> None:
        """Close the plant; may be called twice."""
        self.plant.close()
