"""Closed-loop trials of G1's low-level policies: many robots at once, falls and tracking errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.low_level_excitation import Excitation
from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import compute_projected_gravity, quat_rotate, quat_yaw
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy

FALL_HEIGHT = 0.35
"""Base height below which a robot counts as fallen [m]."""
FALL_TILT = 0.8
"""Tilt of the base above which a robot counts as fallen [rad]."""


class BatchSimulation:
    """Copies of a robot stepped together by `mujoco.rollout`.

    Args:
        models: One model per copy, all of the same structure.
        start: Generalised position after a reset. Shape (nq,).
        threads: Threads of the simulation.
        hands: Bodies on which hand forces act.
    """

    def __init__(
        self,
        models: Sequence[mujoco.MjModel],
        start: np.ndarray,
        threads: int = 2,
        hands: tuple[str, str] = ("left_wrist_yaw_link", "right_wrist_yaw_link"),
    ) -> None:
        self.models, model = list(models), models[0]
        self.substeps = round(POLICY_DT / model.opt.timestep)
        self._start, self._model = np.asarray(start, float), model
        self._datas = [mujoco.MjData(model) for _ in range(max(threads, 1))]
        self._rollout = rollout.Rollout(nthread=threads)
        self._hands = [model.body(name).id for name in hands]
        self._spec = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)
        self.state = np.zeros((len(models), 1 + model.nq + model.nv))
        self.reset(np.ones(len(models), bool))

    @property
    def qpos(self) -> np.ndarray:
        """Generalised positions. Shape (n, nq), a view."""
        return self.state[:, 1 : 1 + self._model.nq]

    @property
    def qvel(self) -> np.ndarray:
        """Generalised velocities. Shape (n, nv), a view."""
        return self.state[:, 1 + self._model.nq :]

    def reset(self, which: np.ndarray) -> None:
        """Put the robots `which` (n,) back at the start, at rest."""
        self.state[which] = 0.0
        self.qpos[which] = self._start

    def push(self, change: np.ndarray) -> None:
        """Add `change` (n, 2) to the planar velocities of the bases, world [m/s]."""
        self.qvel[:, :2] += change

    def step(self, targets: np.ndarray, hand_force: np.ndarray | None = None) -> None:
        """Advance all robots by one policy step of 20 ms.

        Args:
            targets: Motor targets. Shape (n, nu).
            hand_force: Forces on left and right hand, world [N]. Shape (n, 2, 3).
        """
        n, nu = targets.shape
        control = np.zeros((n, nu + 6 * self._model.nbody))
        control[:, :nu] = targets
        if hand_force is not None:
            for side, body in enumerate(self._hands):
                column = nu + 6 * body
                control[:, column : column + 3] = hand_force[:, side]
        states, _ = self._rollout.rollout(
            self.models,
            self._datas,
            self.state,
            np.repeat(control[:, None], self.substeps, axis=1),
            control_spec=self._spec,
        )
        self.state = np.array(states)[:, -1].copy()

    def fallen(self) -> np.ndarray:
        """Return which robots are too low, too tilted or not finite. Shape (n,), bool."""
        upright = -compute_projected_gravity(self.qpos[:, 3:7])[:, 2]
        low = self.qpos[:, 2] < FALL_HEIGHT
        return low | (upright < np.cos(FALL_TILT)) | ~np.isfinite(self.state).all(axis=1)

    def velocity(self) -> np.ndarray:
        """Return the velocity in the heading frame: vx, vy [m/s], yaw rate [rad/s]. (n, 3)."""
        yaw = quat_yaw(self.qpos[:, 3:7])
        cos, sin = np.cos(yaw), np.sin(yaw)
        vx, vy = self.qvel[:, 0], self.qvel[:, 1]
        world = quat_rotate(self.qpos[:, 3:7], self.qvel[:, 3:6])
        return np.stack([cos * vx + sin * vy, cos * vy - sin * vx, world[:, 2]], axis=1)

    def close(self) -> None:
        """Stop the threads."""
        self._rollout.close()


@dataclass(frozen=True)
class TrialResult:
    """Outcome of a batch of trials; errors cover the time before a fall.

    Attributes:
        trials: Number of trials.
        seconds: Duration of each [s].
        falls: Number of trials that ended in a fall.
        height_rmse: RMS error of the base height in stance [m].
        vx_rmse: RMS error of the forward velocity when walking [m/s].
        vy_rmse: RMS error of the lateral velocity when walking [m/s].
        planar_rmse: RMS error of the planar velocity when walking, √(vx² + vy²) [m/s].
        yaw_rate_rmse: RMS error of the yaw rate when walking [rad/s].
        waist_yaw_rmse: RMS error of the waist yaw in stance [rad].
        stance_drift: Median planar speed of the base in stance [m/s].
    """

    trials: int
    seconds: float
    falls: int
    height_rmse: float
    vx_rmse: float
    vy_rmse: float
    planar_rmse: float
    yaw_rate_rmse: float
    waist_yaw_rmse: float
    stance_drift: float


def run_trials(
    policy: LowLevelPolicy, simulation: BatchSimulation, excitation: Excitation
) -> TrialResult:
    """Run `policy` on every sequence of `excitation`, one robot each, and compute its errors."""
    steps, n, _ = excitation.command.shape
    simulation.reset(np.ones(n, bool))
    memory, up = policy.initial_memory(n), np.ones(n, bool)
    error = np.full((steps, n, 5), np.nan)  # height, vx, vy, yaw rate, waist yaw
    speed = np.full((steps, n), np.nan)
    for step in range(steps):
        simulation.push(excitation.push[step])
        command, mode = excitation.command[step], excitation.mode[step]
        targets, memory = policy.act(
            simulation.qpos, simulation.qvel, command, excitation.arms[step], memory, mode
        )
        simulation.step(targets, excitation.hand_force[step])
        down = simulation.fallen()
        up &= ~down
        simulation.reset(~up)  # a fallen robot no longer counts, and is cheap to step at rest
        velocity = simulation.velocity()
        error[step, up, 0] = (simulation.qpos[:, 2] - command[:, 0])[up]
        error[step, up, 1:4] = (velocity - command[:, 4:7])[up]
        error[step, up, 4] = (simulation.qpos[:, 19] - command[:, 1])[up]
        speed[step, up] = np.hypot(velocity[:, 0], velocity[:, 1])[up]
    stance = excitation.mode == Mode.STATIONARY
    height, waist = (_rms(error[..., column][stance]) for column in (0, 4))
    vx, vy, yaw = (_rms(error[..., column][~stance]) for column in (1, 2, 3))
    return TrialResult(
        trials=n,
        seconds=steps * POLICY_DT,
        falls=int((~up).sum()),
        height_rmse=height,
        vx_rmse=vx,
        vy_rmse=vy,
        planar_rmse=float(np.hypot(vx, vy)),
        yaw_rate_rmse=yaw,
        waist_yaw_rmse=waist,
        stance_drift=float(np.nanmedian(speed[stance])),
    )


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(error**2)))
