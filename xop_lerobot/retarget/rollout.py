"""Batched rollouts of command sequences in MuJoCo with the low-level policy in the loop."""

from __future__ import annotations

import copy
from time import perf_counter
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadShape, BadValue
from xop_lerobot.low_level.policy import POLICY_DT, LowLevelPolicy

_DIVERGED = 1e4  # positions [m, rad] or velocities [m/s, rad/s] beyond this have diverged


class Prediction(NamedTuple):
    """Result of a batch of rollouts.

    Attributes:
        qpos: Positions at each control step; step 0 is the start. Shape (K, H + 1, nq).
        qvel: Velocities at each control step. Shape (K, H + 1, nv).
        commands: The commands that were rolled out. Shape (K, H, k).
        sensordata: Sensors of the planning model at the start, then one physics step before the
            end of each control step, since MuJoCo evaluates them at the beginning of a step.
            Shape (K, H + 1, nsensordata).
        memory: The policy's memory at the end. Shape (K, nm).
        policy_s: Time in the low-level policy [s].
        physics_s: Time in MuJoCo [s].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    commands: np.ndarray
    sensordata: np.ndarray
    memory: np.ndarray
    policy_s: float
    physics_s: float


class PolicyRollout:
    """Rolls out command sequences in parallel, one policy call per control step (Eqs. 1b, 1c).

    The thread pool lives as long as the object; results do not depend on its size.

    Args:
        model: Planning model; it is not modified.
        policy: Low-level policy; it adapts the motors of a copy of the model.
        num_threads: Threads of the physics.

    Raises:
        BadValue: If 20 ms is not a whole multiple of the model's time step.
    """

    def __init__(self, model: mujoco.MjModel, policy: LowLevelPolicy, num_threads: int) -> None:
        # Autoreset would silently restart a diverged sample, which would then look healthy.
        self.model, self.policy = copy.copy(model), policy
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        policy.adapt(self.model)
        self.substeps = round(POLICY_DT / model.opt.timestep)
        if abs(self.substeps * model.opt.timestep - POLICY_DT) > 1e-9:
            raise BadValue(
                f"the policy period {POLICY_DT} s must be a whole multiple of the time step "
                f"{model.opt.timestep} s"
            )
        # nthread=0 runs in the caller's thread; a pool of one thread would only add overhead.
        self._pool = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._data = [mujoco.MjData(model) for _ in range(max(num_threads, 1))]
        self._start = mujoco.MjData(model)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()

    def predict(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        memory: np.ndarray,
        commands: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
        executed: tuple[np.ndarray, np.ndarray, Mode] | None = None,
    ) -> Prediction:
        """Roll out `commands` from one start state and one policy memory (Eqs. 1e, 1f).

        Args:
            qpos: Start position. Shape (nq,).
            qvel: Start velocity. Shape (nv,).
            memory: The policy's memory h at the start. Shape (nm,).
            commands: Command sequences. Shape (K, H, k).
            arms: Arm and gripper targets, constant or one sequence per sample. Shape (m,) or
                (K, H, m).
            mode: Mode of the low-level policy.
            executed: Command, arms and mode executed last: motor targets are interpolated
                linearly from theirs, as on a robot with `Morphology.ramps`; None for steps.

        Returns:
            The predicted states; all NaN for a sample that diverged.

        Raises:
            BadShape: If the policy returns targets of a wrong shape.
        """
        nq, nv = self.model.nq, self.model.nv
        num_rollouts, horizon, _ = commands.shape
        states = np.empty((num_rollouts, horizon + 1, 1 + nq + nv + self.model.na))
        states[:, 0] = 0
        states[:, 0, 1 : 1 + nq], states[:, 0, 1 + nq : 1 + nq + nv] = qpos, qvel
        out = np.empty((num_rollouts, self.substeps, states.shape[2]))
        sensed = np.empty((num_rollouts, self.substeps, self.model.nsensordata))
        controls = np.empty((num_rollouts, self.substeps, self.model.nu))
        sensordata = np.empty((num_rollouts, horizon + 1, self.model.nsensordata))
        sensordata[:, 0] = self._sense(qpos, qvel)
        arms = np.broadcast_to(arms, (num_rollouts, horizon, arms.shape[-1]))
        memory = np.broadcast_to(memory, (num_rollouts, len(memory)))
        models = [self.model] * num_rollouts
        policy_s = physics_s = 0.0
        last = None if executed is None else self._find_targets(qpos, qvel, memory, executed)
        shares = np.arange(1, self.substeps + 1)[:, None] / self.substeps
        for step in range(horizon):
            start = perf_counter()
            targets, memory = self.policy.act(
                states[:, step, 1 : 1 + nq],
                states[:, step, 1 + nq : 1 + nq + nv],
                commands[:, step],
                arms[:, step],
                memory,
                mode,
            )
            between = perf_counter()
            if targets.shape != (num_rollouts, self.model.nu):
                raise BadShape("targets", (num_rollouts, self.model.nu), targets.shape)
            if last is None:
                controls[:] = targets[:, None]
            else:
                controls[:] = last[:, None] + shares * (targets - last)[:, None]
                last = targets
            # Shapes are known to fit; checking and tiling them would take 0.15 ms per call.
            self._pool.rollout(
                models,
                self._data,
                np.ascontiguousarray(states[:, step]),
                controls,
                skip_checks=True,
                nstep=self.substeps,
                state=out,
                sensordata=sensed,
            )
            states[:, step + 1] = out[:, -1]
            sensordata[:, step + 1] = sensed[:, -1]
            end = perf_counter()
            policy_s += between - start
            physics_s += end - between
        sound = (np.abs(states[..., 1:]) < _DIVERGED).all(axis=(1, 2))
        if not sound.all():
            states[~sound] = sensordata[~sound] = np.nan
        return Prediction(
            states[..., 1 : 1 + nq],
            states[..., 1 + nq : 1 + nq + nv],
            commands,
            sensordata,
            memory,
            policy_s,
            physics_s,
        )

    def _find_targets(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        memory: np.ndarray,
        executed: tuple[np.ndarray, np.ndarray, Mode],
    ) -> np.ndarray:
        """Motor targets of the executed command. Shape (1, nu)."""
        command, arms, mode = executed
        targets, _ = self.policy.act(
            qpos[None], qvel[None], command[None], arms[None], memory[:1], mode
        )
        return targets

    def _sense(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Sensor readings at the start. Shape (nsensordata,)."""
        data = self._start
        data.qpos[:], data.qvel[:] = qpos, qvel
        # Only the stages that position and velocity sensors need; no contacts, no inertia.
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_sensorPos(self.model, data)
        mujoco.mj_comVel(self.model, data)
        mujoco.mj_sensorVel(self.model, data)
        return data.sensordata
