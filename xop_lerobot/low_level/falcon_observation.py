"""What FALCON's network sees and what its output means; shared by `falcon` and the student.

Frame (115 numbers, keys in alphabetical order, scales of the trained checkpoint):

========================  ====  =====================================================
actions                    29   output of the network one step ago
base_ang_vel                3   body frame [rad/s] x 0.25
command_ang_vel             1   yaw rate [rad/s]
command_base_height         1   base height [m] x 2
command_lin_vel             2   vx, vy [m/s]
command_stand               1   1 walks, 0 stands
command_waist_dofs          3   yaw, roll, pitch [rad]
dof_pos                    29   joint angles less the default posture [rad]; waist roll and
                                pitch less their command, see below
dof_vel                    29   joint velocities [rad/s] x 0.05
projected_gravity           3   unit gravity in the body frame
ref_upper_dof_pos          14   arm targets [rad]
========================  ====  =====================================================

The checkpoint was trained with waist roll and pitch held at zero and does not follow them, so
their two motors get the commanded angle directly. The network is shown these two angles
relative to the command: a leaning torso is then a load to it, like a weight in the hands,
with which it was trained, and not a posture that it has never seen. (Shown the true angles, it
slides off: 0.9 m and half a turn in 10 s at a pitch of 0.3 rad, against 0.1 m and 0.1 rad.)
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from xop_lerobot.command import Mode
from xop_lerobot.errors import BadShape
from xop_lerobot.low_level.policy import LowLevelPolicy, PolicyOutput
from xop_lerobot.transforms import compute_projected_gravity

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = (
    "shoulder_pitch",
    "shoulder_roll",
    "shoulder_yaw",
    "elbow",
    "wrist_roll",
    "wrist_pitch",
    "wrist_yaw",
)
JOINT_NAMES: tuple[str, ...] = (
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"{side}_{joint}_joint" for side in ("left", "right") for joint in ARM),
)
"""Order of joints and actuators that the network was trained with."""

NUM_JOINTS = len(JOINT_NAMES)
NUM_ARM_JOINTS = 14
NUM_COMMANDS = 7
NQ, NV = 7 + NUM_JOINTS, 6 + NUM_JOINTS
WAIST_TILT = slice(13, 15)
"""Waist roll and pitch, whose motors bypass the network."""
ARMS = slice(15, 29)

FRAME_SIZE = 115
HISTORY = 5
OBSERVATION_SIZE = FRAME_SIZE * HISTORY
MEMORY_SIZE = NUM_JOINTS + OBSERVATION_SIZE

MOVES = OBSERVATION_SIZE - FRAME_SIZE + 36
"""Column of an observation that says whether the robot walks now."""

ACTION_SCALE = 0.25
ACTION_LIMIT = 100.0


def _read_only(values: list[float]) -> np.ndarray:
    array = np.array(values)
    array.setflags(write=False)
    return array


_LEG_DEFAULT = [-0.1, 0, 0, 0.3, -0.2, 0]
DEFAULT_POSTURE = _read_only([*_LEG_DEFAULT, *_LEG_DEFAULT, *[0.0] * 17])
"""Posture of a zero action [rad]. Shape (29,)."""

LOWER_LIMITS = _read_only(
    [-2.5307, -0.5236, -2.7576, -0.087267, -0.87267, -0.2618]
    + [-2.5307, -2.9671, -2.7576, -0.087267, -0.87267, -0.2618]
    + [-2.618, -0.52, -0.52]
    + [-3.0892, -1.5882, -2.618, -1.0472, -1.97222, -1.61443, -1.61443]
    + [-3.0892, -2.2515, -2.618, -1.0472, -1.97222, -1.61443, -1.61443]
)
"""Lower joint limits, to which targets are clipped [rad]. Shape (29,)."""

UPPER_LIMITS = _read_only(
    [2.8798, 2.9671, 2.7576, 2.8798, 0.5236, 0.2618]
    + [2.8798, 0.5236, 2.7576, 2.8798, 0.5236, 0.2618]
    + [2.618, 0.52, 0.52]
    + [2.6704, 2.2515, 2.618, 2.0944, 1.97222, 1.61443, 1.61443]
    + [2.6704, 1.5882, 2.618, 2.0944, 1.97222, 1.61443, 1.61443]
)
"""Upper joint limits, to which targets are clipped [rad]. Shape (29,)."""


CALM = (0.8, 0.3, 0.3, 0.8, 0.0, 0.3, 0.3)
"""Part of each angle of an arm, shoulder to wrist, that FALCON is shown; see `calm_arms`."""


def _make_calm_view() -> np.ndarray:
    view = np.ones((HISTORY, FRAME_SIZE))
    view[:, 40:69][:, ARMS] = view[:, 101:115] = CALM * 2
    view = view.reshape(OBSERVATION_SIZE)
    view.setflags(write=False)
    return view


CALM_VIEW = _make_calm_view()
"""Factors that shrink the arms' angles and targets in an observation. Shape (575,)."""


def calm_arms(observation: np.ndarray) -> np.ndarray:
    """Show FALCON arms that are nearer to its default posture than they are.

    It was trained on arm motions of people, and in postures at the ends of the joints' ranges it
    walks off at a command of zero, or falls. The legs hardly need to know the arms' posture: what
    it does to the balance they feel by the tilt of the base, as they feel a weight in the hands.
    They are shown at `CALM` of their angles: most of what swings the arms fore and aft, less of
    the rest. docs/low_level.md has the measurements.

    Args:
        observation: Observations. Shape (n, 575), float32.

    Returns:
        Shape (n, 575), float32.
    """
    return observation * CALM_VIEW.astype(np.float32)


def compute_waist_tilt(command: np.ndarray) -> np.ndarray:
    """Commanded waist roll and pitch within their limits [rad]. Shape (n, 7) -> (n, 2)."""
    low, high = LOWER_LIMITS[WAIST_TILT], UPPER_LIMITS[WAIST_TILT]
    return np.minimum(np.maximum(command[:, 2:4], low), high)


def build_observation(
    qpos: np.ndarray,
    qvel: np.ndarray,
    command: np.ndarray,
    arms: np.ndarray,
    memory: np.ndarray,
    mode: Mode | np.ndarray,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Build the last five frames, oldest first, ending with the one of now.

    Args:
        qpos: Generalised positions. Shape (n, 36).
        qvel: Generalised velocities, angular velocity of the base in the body. Shape (n, 35).
        command: height, waist yaw, roll, pitch, vx, vy, yaw rate. Shape (n, 7).
        arms: Arm targets, left then right [rad]. Shape (n, 14).
        memory: Last action, then the five frames before. Shape (n, 604).
        mode: Mode of all, or one of each. Shape () or (n,).
        out: Where to write them; a new array by default. Shape (n, 575).

    Returns:
        Shape (n, 575).
    """
    observation = np.empty((len(qpos), OBSERVATION_SIZE)) if out is None else out
    observation[:, :-FRAME_SIZE] = memory[:, NUM_JOINTS + FRAME_SIZE :]
    frame = observation[:, -FRAME_SIZE:]
    frame[:, 0:29] = memory[:, :NUM_JOINTS]
    np.multiply(qvel[:, 3:6], 0.25, out=frame[:, 29:32])
    frame[:, 32] = command[:, 6]
    frame[:, 33] = 2.0 * command[:, 0]
    frame[:, 34:36] = command[:, 4:6]
    frame[:, 36] = np.asarray(mode) == Mode.MOBILE
    frame[:, 37] = command[:, 1]
    frame[:, 38:40] = 0.0
    np.subtract(qpos[:, 7:], DEFAULT_POSTURE, out=frame[:, 40:69])
    frame[:, 40:69][:, WAIST_TILT] -= compute_waist_tilt(command)
    np.multiply(qvel[:, 6:], 0.05, out=frame[:, 69:98])
    frame[:, 98:101] = compute_projected_gravity(qpos[:, 3:7])
    frame[:, 101:115] = arms
    return observation


def compute_targets(action: np.ndarray, command: np.ndarray, arms: np.ndarray) -> np.ndarray:
    r"""Compute motor targets :math:`q^* = q_0 + 0.25\,a`, plus the arm targets on the arms.

    The motors of waist roll and pitch get the commanded angle itself.

    Args:
        action: Output of the network. Shape (n, 29).
        command: Commands. Shape (n, 7).
        arms: Arm targets [rad]. Shape (n, 14).

    Returns:
        Targets within the joint limits [rad]. Shape (n, 29).
    """
    targets = DEFAULT_POSTURE + ACTION_SCALE * action
    targets[:, ARMS] += arms
    targets[:, WAIST_TILT] = command[:, 2:4]
    np.maximum(targets, LOWER_LIMITS, out=targets)
    return np.minimum(targets, UPPER_LIMITS, out=targets)


def check_batch(name: str, array: np.ndarray, n: int, size: int) -> np.ndarray:
    """Return `array` as floats of shape (n, size).

    Raises:
        BadShape: Naming the argument, its expected and its actual shape.
    """
    array = np.asarray(array, dtype=float)
    if array.shape != (n, size):
        raise BadShape(name, (n, size), array.shape)
    return array


class FalconLikePolicy(LowLevelPolicy):
    """A network with FALCON's inputs, outputs and memory: last action, then five frames."""

    memory_size = MEMORY_SIZE
    # With arms swung back beyond this, farther than people can, it walks off by metres.
    arm_limits = {f"{side}_shoulder_pitch_joint": (-3.0892, 1.5) for side in ("left", "right")}

    @abstractmethod
    def infer(self, observation: np.ndarray) -> np.ndarray:
        """Run the network on a batch.

        Args:
            observation: Five frames, oldest first, float32. Shape (n, 575).

        Returns:
            Actions. Shape (n, 29).
        """

    def initial_memory(self, n: int = 1) -> np.ndarray:
        """Zeros, as the network was deployed with. Shape (n, 604)."""
        return np.zeros((n, MEMORY_SIZE))

    def act(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: Mode | np.ndarray,
    ) -> PolicyOutput:
        """Compute motor targets for the next 20 ms; see `LowLevelPolicy.act`.

        `mode` may also hold one mode for each member of the batch. Shape (n,).

        Raises:
            BadShape: If an argument does not fit the G1 with 29 joints.
        """
        n = len(qpos)
        qpos = check_batch("qpos", qpos, n, NQ)
        qvel = check_batch("qvel", qvel, n, NV)
        command = check_batch("command", command, n, NUM_COMMANDS)
        arms = check_batch("arms", arms, n, NUM_ARM_JOINTS)
        memory = check_batch("memory", memory, n, MEMORY_SIZE)
        after = np.empty((n, MEMORY_SIZE))  # the memory after this step: action and observation
        observation = after[:, NUM_JOINTS:]
        build_observation(qpos, qvel, command, arms, memory, mode, out=observation)
        action = self.infer(observation.astype(np.float32))
        action = np.minimum(np.maximum(action, -ACTION_LIMIT), ACTION_LIMIT)
        after[:, :NUM_JOINTS] = action
        return PolicyOutput(compute_targets(action, command, arms), after)
