"""AMO's released policy for the G1 (Li et al., RSS 2025), from files that the user has.

AMO drives legs and waist; the arms follow their targets. Its files are not ours to pass on, and
nothing of them is on this machine unless the user puts it there: `amo_jit.pt`, `adapter_jit.pt`
and `adapter_norm_stats.pt` of github.com/OpenTeleVision/AMO, in one folder.

Frame (93 numbers, 23 joints: legs, waist, shoulders and elbows, without wrists):

====================  ====  ==========================================================
base angular velocity    3   body frame [rad/s] x 0.25
roll, pitch              2   of the base [rad]
sin, cos                 2   of the heading less the wanted one; 0, 1 while it stands
joint angles            23   less the default posture [rad]
joint velocities        23   [rad/s] x 0.05
last action             23   15 of the policy, then eight zeros
gait                     2   sin of two phases
adapter                 15   its angles for legs and waist
====================  ====  ==========================================================

The policy sees the frame, a demand (arms, vx, vy, torso yaw, pitch, roll, three times the
height), three zeros, the last ten frames, and apart from these the last 25 with this one. What
the deployment script shows for arms at their default posture is shown here for arms where they
are; it takes a heading, so the wanted one is the integral of the commanded yaw rate.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.errors import PolicyFileError
from xop_lerobot.low_level.falcon_observation import (
    JOINT_NAMES,
    NQ,
    NUM_ARM_JOINTS,
    NUM_COMMANDS,
    NV,
    check_batch,
)
from xop_lerobot.low_level.policy import POLICIES, POLICY_DT, LowLevelPolicy, PolicyOutput
from xop_lerobot.transforms import quat_yaw, wrap_angle

if TYPE_CHECKING:
    import mujoco

FILES = ("amo_jit.pt", "adapter_jit.pt", "adapter_norm_stats.pt")
STATISTICS = ("input_mean", "input_std", "output_mean", "output_std")

NUM_LOWER = 15
"""Joints that the policy drives: twelve of the legs, then waist yaw, roll and pitch."""
NUM_UPPER = 8
"""Arm joints that it sees: three of each shoulder and the elbow, left then right."""
UPPER = np.array([0, 1, 2, 3, 7, 8, 9, 10])
"""These among the 14 arm targets."""
SEEN = np.concatenate([np.arange(NUM_LOWER), NUM_LOWER + UPPER])
"""Joints that the policy sees, among the robot's 29. Shape (23,)."""

DEFAULT_POSTURE = np.array(
    [-0.1, 0, 0, 0.3, -0.2, 0] * 2 + [0.0] * 3 + [0.5, 0, 0.2, 0.3, 0.5, 0, -0.2, 0.3]
)
"""Posture from which angles count [rad]. Shape (23,)."""
LEG_GAINS = ((150, 2), (150, 2), (150, 2), (300, 4), (80, 2), (20, 1))
ARM_GAINS = ((80, 2), (80, 2), (40, 1), (60, 1))
GAINS = (*LEG_GAINS, *LEG_GAINS, *[(400, 15)] * 3, *ARM_GAINS, *ARM_GAINS)
"""Stiffness [N m/rad] and damping [N m s/rad] that it was trained with, of what it sees."""
LEG_LIMITS = (88, 139, 88, 139, 50, 50)
LIMITS = (*LEG_LIMITS, *LEG_LIMITS, 88, 50, 50, *[25] * NUM_UPPER)
"""Torque limits, of what it sees [N m]."""

FRAME_SIZE = 3 + 2 + 2 + 3 * 23 + 2 + NUM_LOWER
HISTORY, LONG_HISTORY = 10, 25
ACTION_SCALE, ACTION_LIMIT = 0.25, 40.0
GAIT_HZ = 1.3
STANDING_SPEED = 0.1
"""Forward speed under which it stands, whatever else is asked of it [m/s]."""

_ACTION = slice(0, NUM_LOWER)
_PHASES = slice(NUM_LOWER, NUM_LOWER + 2)
_STANDS = NUM_LOWER + 2
_HEADING = NUM_LOWER + 3
_FRAMES = NUM_LOWER + 4


def find_amo_folder(path: str | None = None) -> Path:
    """Find AMO's files: in the folder `path`, else in the cache.

    Raises:
        PolicyFileError: If one is missing; says where it is looked for.
    """
    if path is None:
        import pooch  # noqa: PLC0415

        folder = Path(pooch.os_cache("xop-lerobot")) / "amo"
    else:
        folder = Path(path).expanduser()
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise PolicyFileError(
            f"AMO's {', '.join(missing)} is not in '{folder}'. Put the files of "
            "github.com/OpenTeleVision/AMO there, or name their folder as the policy's path"
        )
    return folder


class Amo(LowLevelPolicy):
    """AMO; its commands are FALCON's, and its gains are set by `adapt`.

    Args:
        path: Folder of its three files; None for the cache.

    Raises:
        PolicyFileError: If a file is missing or not what it should be.
    """

    name = "amo"
    memory_size = _FRAMES + LONG_HISTORY * FRAME_SIZE

    def __init__(self, path: str | None = None) -> None:
        folder = find_amo_folder(path)
        self._policy = _load_network(folder / FILES[0])
        self._adapter = _load_network(folder / FILES[1])
        self._statistics = _load_statistics(folder / FILES[2])

    def adapt(self, model: mujoco.MjModel) -> None:
        """Give the motors that it was trained with to `model`; the wrists keep theirs."""
        for joint, (stiffness, damping), limit in zip(SEEN, GAINS, LIMITS, strict=True):
            index = model.actuator(JOINT_NAMES[joint]).id
            model.actuator_gainprm[index, 0] = stiffness
            model.actuator_biasprm[index, 1:3] = -stiffness, -damping
            model.actuator_forcerange[index] = -limit, limit

    def initial_memory(self, n: int = 1) -> np.ndarray:
        """No action and no frame yet, standing, both phases at a quarter. Shape (n, 2344)."""
        memory = np.zeros((n, self.memory_size))
        memory[:, _PHASES] = 0.25
        memory[:, _STANDS] = 1.0
        return memory

    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode,
    ) -> PolicyOutput:
        """Compute motor targets for the next 20 ms; see `LowLevelPolicy.act`.

        Raises:
            BadShape: If an argument does not fit the G1 with 29 joints.
        """
        n = len(qpos)
        qpos = check_batch("qpos", qpos, n, NQ)
        qvel = check_batch("qvel", qvel, n, NV)
        command = check_batch("command", command, n, NUM_COMMANDS)
        arms = check_batch("arms", arms, n, NUM_ARM_JOINTS)
        after = check_batch("memory", memory, n, self.memory_size).copy()
        frame = self._build_frame(qpos, qvel, command, after)
        frames = after[:, _FRAMES:]
        recent = frames[:, -HISTORY * FRAME_SIZE :].copy()
        frames[:, :-FRAME_SIZE] = frames[:, FRAME_SIZE:].copy()
        frames[:, -FRAME_SIZE:] = frame
        demand = _build_demand(command, arms)
        observation = np.concatenate([frame, demand, np.zeros((n, 3)), recent], axis=1)
        raw = np.clip(self._infer(observation, frames), -ACTION_LIMIT, ACTION_LIMIT)
        stands = np.abs(command[:, 4]) < STANDING_SPEED
        after[:, _ACTION] = raw
        after[:, _PHASES] = _advance_phases(after[:, _PHASES], stands)
        after[:, _STANDS] = stands
        lower = DEFAULT_POSTURE[:NUM_LOWER] + ACTION_SCALE * raw
        return PolicyOutput(np.concatenate([lower, arms], axis=1), after)

    def _build_frame(
        self, qpos: np.ndarray, qvel: np.ndarray, command: np.ndarray, memory: np.ndarray
    ) -> np.ndarray:
        """The frame of now; the wanted heading in `memory` goes on. Shape (n, 93)."""
        n = len(qpos)
        yaw = quat_yaw(qpos[:, 3:7])
        stands = memory[:, _STANDS] > 0
        wanted = memory[:, _HEADING] + command[:, 6] * POLICY_DT
        memory[:, _HEADING] = wrap_angle(np.where(stands, yaw, wanted))
        turn = np.where(stands, 0.0, yaw - memory[:, _HEADING])
        joints = qpos[:, 7:][:, SEEN]
        return np.concatenate(
            [
                0.25 * qvel[:, 3:6],
                _compute_roll_pitch(qpos[:, 3:7]),
                np.sin(turn)[:, None],
                np.cos(turn)[:, None],
                joints - DEFAULT_POSTURE,
                0.05 * qvel[:, 6:][:, SEEN],
                memory[:, _ACTION],
                np.zeros((n, NUM_UPPER)),
                np.sin(2 * np.pi * memory[:, _PHASES]),
                self._run_adapter(command, joints[:, NUM_LOWER:]),
            ],
            axis=1,
        )

    def _run_adapter(self, command: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Angles of legs and waist for a height, a torso and arms. Shape (n, 15)."""
        import torch  # noqa: PLC0415

        mean, std, out_mean, out_std = self._statistics
        wanted = np.concatenate([command[:, [0, 1, 3, 2]], upper], axis=1)
        scaled = (wanted - mean) / (std + 1e-8)
        with torch.no_grad():
            output = self._adapter(torch.from_numpy(scaled).float())
        return output.numpy().reshape(len(command), NUM_LOWER) * out_std + out_mean

    def _infer(self, observation: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Run the policy, row by row: it was exported for one robot. Shape (n, 15)."""
        import torch  # noqa: PLC0415

        rows = zip(
            torch.from_numpy(observation).float(),
            torch.from_numpy(frames.copy()).float(),
            strict=True,
        )
        with torch.no_grad():
            outputs = [self._policy(row[None], history[None]).reshape(-1) for row, history in rows]
        return torch.stack(outputs).numpy().astype(float)


def _build_demand(command: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """What is wanted: arms, vx, vy, zero, torso yaw, pitch, roll, the height. Shape (n, 17)."""
    return np.concatenate(
        [
            arms[:, UPPER],
            command[:, 4:6],
            np.zeros((len(command), 1)),
            command[:, [1, 3, 2]],
            np.repeat(command[:, :1], 3, axis=1),
        ],
        axis=1,
    )


def _advance_phases(phases: np.ndarray, stands: np.ndarray) -> np.ndarray:
    """Let 20 ms of gait pass: who stands stops at a quarter, who sets off parts the feet."""
    phases = np.remainder(phases + POLICY_DT * GAIT_HZ, 1.0)
    near = np.abs(phases - 0.25) < 0.05  # noqa: PLR2004
    stop, go = stands & near.any(axis=1), ~stands & near.all(axis=1)
    phases[stop] = 0.25, 0.25
    phases[go] = 0.25, 0.75
    return phases


def _compute_roll_pitch(quat: np.ndarray) -> np.ndarray:
    """Roll and pitch of the base [rad]. Shape (n, 4) -> (n, 2)."""
    w, x, y, z = quat.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch], axis=1)


def _load_network(file: Path) -> Any:
    import torch  # noqa: PLC0415

    try:
        return torch.jit.load(str(file), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        raise PolicyFileError(f"policy file '{file}' is no TorchScript network") from error


def _load_statistics(file: Path) -> tuple[np.ndarray, ...]:
    """Means and deviations of the adapter's input and output. Shapes (12,), (12,), (15,), (15,).

    Nothing but arrays is unpickled: the file may not run code.
    """
    import pickle  # noqa: PLC0415

    import torch  # noqa: PLC0415

    allowed: list[Any] = [
        np._core.multiarray._reconstruct,  # pyright: ignore[reportAttributeAccessIssue]
        np._core.multiarray.scalar,  # pyright: ignore[reportAttributeAccessIssue]
        np.ndarray,
        np.dtype,
        *(type(np.dtype(kind)) for kind in (np.float32, np.float64)),
    ]
    # Files of NumPy 1 name these in `numpy.core`.
    aliases: list[Any] = [
        (function, f"numpy.core.multiarray.{function.__name__}") for function in allowed[:2]
    ]
    try:
        with torch.serialization.safe_globals([*allowed, *aliases]):
            found = torch.load(str(file), map_location="cpu", weights_only=True)
        arrays = tuple(np.asarray(found[name], float).reshape(-1) for name in STATISTICS)
    except (pickle.UnpicklingError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise PolicyFileError(
            f"policy file '{file}' holds no arrays {', '.join(STATISTICS)}"
        ) from error
    sizes = tuple(array.size for array in arrays)
    expected = (4 + NUM_UPPER, 4 + NUM_UPPER, NUM_LOWER, NUM_LOWER)
    if sizes != expected:
        raise PolicyFileError(f"policy file '{file}' must hold {expected} numbers, got {sizes}")
    return arrays


POLICIES.add("amo", Amo)
