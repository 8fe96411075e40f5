"""Plain readings of six published layouts of G1 policies: one robot, step by step, slow.

What a table-driven, batched executor is compared with. Every class says in the order of its
statements what happens before and after the network is asked: whether the clock has moved on,
whether the frame of now is in the history already, and which output is remembered. Nothing here
is fast, clever or shared beyond gravity and joint order, so that an error of the executor is not
repeated here.

All of them are called as ``step(qpos, qvel, command, arms, mode)`` every 20 ms and return what
the network was shown and the 29 motor targets. Networks are callables on float32 arrays with a
leading batch dimension of one, so that made-up ones fit as well as ONNX files.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.low_level.joints import read_joints

Network = Callable[..., np.ndarray]
"""Observation, shape (1, n) float32, to action, shape (1, m)."""
RecurrentNetwork = Callable[..., tuple[np.ndarray, np.ndarray]]
"""Observation (1, n) and hidden state (1, 1, 256) to action (1, m) and the next hidden state."""

DT = 0.02
LEGS = list(range(12))
WAIST_YAW, WAIST_ROLL, WAIST_PITCH = 12, 13, 14
ARMS = list(range(15, 29))
LEG_DEFAULT = [-0.1, 0.0, 0.0, 0.3, -0.2, 0.0] * 2
"""Posture of a zero action, the same of five of the six [rad]."""


class Step(NamedTuple):
    """What one step of a plain policy returns.

    Attributes:
        observation: What the network was shown, float32. Shape (n,).
        targets: Motor targets, in the order of the model [rad]. Shape (29,).
    """

    observation: np.ndarray
    targets: np.ndarray


class Command(NamedTuple):
    """One command: base height [m], waist angles [rad], velocities [m/s, rad/s]."""

    height: float
    waist_yaw: float
    waist_roll: float
    waist_pitch: float
    vx: float
    vy: float
    yaw_rate: float


def compute_gravity(qpos: np.ndarray) -> list[float]:
    """Unit gravity in the body frame of a base of orientation wxyz `qpos[3:7]`. Length 3."""
    w, x, y, z = (float(value) for value in qpos[3:7])
    return [2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1]


def clip_targets(targets: np.ndarray) -> np.ndarray:
    """Keep targets within the joint limits. Shape (29,) -> (29,)."""
    return np.clip(targets, read_joints("g1").low, read_joints("g1").high)


class PlainOpenWbtSquat:
    """OpenWBT's standing network: height and pitch of the whole body, 78 numbers, a GRU.

    It sees all joints at their true angles and drives the legs. Published code holds the three
    waist joints at zero; here yaw and roll follow the command by their motors, and pitch stays
    at zero, since a commanded pitch is the network's to reach with the legs. The velocities of
    the command, and the mode, are not looked at.

    Args:
        network: See `RecurrentNetwork`.
        clip: Whether targets are kept within the joint limits; the published code does not.
    """

    default = np.array([*LEG_DEFAULT, *[0.0] * 3, *[0.0, 0.3, 0.0, 1.0], *[0.0] * 3]
                       + [0.0, -0.3, 0.0, 1.0] + [0.0] * 3)  # fmt: skip

    def __init__(self, network: RecurrentNetwork, clip: bool = False) -> None:
        self._network = network
        self._clip = clip
        self._action = np.zeros(12)
        self._hidden = np.zeros((1, 1, 256), np.float32)

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run the network once. Shapes (36,), (35,), (7,), (14,)."""
        del mode
        wanted = Command(*command)
        observation: list[float] = [wanted.height, wanted.waist_pitch]
        observation += compute_gravity(qpos)
        observation += [0.25 * rate for rate in qvel[3:6]]
        observation += [qpos[7 + joint] - self.default[joint] for joint in range(29)]
        observation += [0.05 * qvel[6 + joint] for joint in range(29)]
        observation += list(self._action)
        seen = np.clip(observation, -100.0, 100.0).astype(np.float32)

        output, self._hidden = self._network(seen[None], self._hidden)
        # What is remembered is the clipped action, and the target is made of it too.
        self._action = np.clip(np.asarray(output, float).reshape(12), -100.0, 100.0)

        targets = np.zeros(29)
        for joint in LEGS:
            targets[joint] = self.default[joint] + 0.25 * self._action[joint]
        targets[WAIST_YAW] = wanted.waist_yaw
        targets[WAIST_ROLL] = wanted.waist_roll
        targets[WAIST_PITCH] = 0.0
        targets[ARMS] = arms
        return Step(seen, clip_targets(targets) if self._clip else targets)


class PlainOpenWbtLoco:
    """OpenWBT's walking network: three velocities, legs only, two clocks, a GRU.

    The clock moves on *before* the network is shown it. It is one number in [0, 1); the left
    foot's is half a cycle ahead. Each is stretched so that the stance, the first 60 % of a cycle,
    takes half of the sine. Who stands has both feet at 0.3, a sine of one, and sets off from
    there.

    Args:
        network: See `RecurrentNetwork`.
        clip: Whether targets are kept within the joint limits; the published code does not.
        dead_zone: Velocities smaller than this in size are shown as zero, each by itself. The
            published deployment has 0.1; the network itself has none.
    """

    def __init__(
        self, network: RecurrentNetwork, clip: bool = False, dead_zone: float = 0.0
    ) -> None:
        self._network = network
        self._clip = clip
        self._dead_zone = dead_zone
        self._action = np.zeros(12)
        self._hidden = np.zeros((1, 1, 256), np.float32)
        self._cycle = 0.3

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run the network once. Shapes (36,), (35,), (7,), (14,)."""
        wanted = Command(*command)
        velocity = [wanted.vx, wanted.vy, wanted.yaw_rate]
        velocity = [value if abs(value) >= self._dead_zone else 0.0 for value in velocity]
        self._cycle = (self._cycle + DT * 1.5) % 1.0
        left, right = (self._cycle + 0.5) % 1.0, self._cycle
        if mode == Mode.STATIONARY:
            velocity = [0.0, 0.0, 0.0]
            self._cycle = left = right = 0.3

        observation: list[float] = [2.0 * velocity[0], 2.0 * velocity[1], 0.25 * velocity[2]]
        observation += compute_gravity(qpos)
        observation += [0.25 * rate for rate in qvel[3:6]]
        observation += [qpos[7 + joint] - LEG_DEFAULT[joint] for joint in LEGS]
        observation += [0.05 * qvel[6 + joint] for joint in LEGS]
        observation += list(self._action)
        for foot in (left, right):
            if foot < 0.6:
                stretched = 0.5 * foot / 0.6
            else:
                stretched = 0.5 + 0.5 * (foot - 0.6) / 0.4
            observation.append(float(np.sin(2 * np.pi * stretched)))
        seen = np.clip(observation, -100.0, 100.0).astype(np.float32)

        output, self._hidden = self._network(seen[None], self._hidden)
        self._action = np.clip(np.asarray(output, float).reshape(12), -100.0, 100.0)

        targets = np.zeros(29)
        for joint in LEGS:
            targets[joint] = LEG_DEFAULT[joint] + 0.25 * self._action[joint]
        # The network sees nothing above the legs, so all three waist motors can have the command.
        targets[WAIST_YAW] = wanted.waist_yaw
        targets[WAIST_ROLL] = wanted.waist_roll
        targets[WAIST_PITCH] = wanted.waist_pitch
        targets[ARMS] = arms
        return Step(seen, clip_targets(targets) if self._clip else targets)


class PlainAsap:
    """ASAP's decoupled walker: height, velocities, walk flag, 17 upper targets; 100 + 400 numbers.

    The history holds, for each of twelve terms in alphabetical order, the four frames *before*
    now, newest first; now joins it after the network's input has been built. It begins as zeros.
    The clock is the time since the start, whether the robot walks or not, and is shown as zero
    while it stands.

    Args:
        network: See `Network`.
        clip: Whether targets are kept within the joint limits, as in the published code.
        period: Of the gait [s].
    """

    order = (
        "actions",
        "base_ang_vel",
        "command_ang_vel",
        "command_base_height",
        "command_lin_vel",
        "command_stand",
        "cos_phase",
        "dof_pos",
        "dof_vel",
        "projected_gravity",
        "ref_upper_dof_pos",
        "sin_phase",
    )
    """Terms of the history. The same terms make the frame of now, with the history between
    joint velocities and gravity, where its name falls in the alphabet."""
    widths = (12, 3, 1, 1, 2, 1, 1, 29, 29, 3, 17, 1)

    def __init__(self, network: Network, clip: bool = True, period: float = 0.9) -> None:
        self._network = network
        self._clip = clip
        self._period = period
        self._steps = 0
        self._action = np.zeros(12)
        self._history = {
            name: [[0.0] * width for _ in range(4)]
            for name, width in zip(self.order, self.widths, strict=True)
        }

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run the network once. Shapes (36,), (35,), (7,), (14,)."""
        wanted = Command(*command)
        walks = 1.0 if mode == Mode.MOBILE else 0.0
        upper = [wanted.waist_yaw, wanted.waist_roll, wanted.waist_pitch, *arms]
        time = self._steps * DT * walks
        phase = time % self._period / self._period
        default = [*LEG_DEFAULT, *[0.0] * 17]
        now: dict[str, list[float]] = {
            "actions": list(self._action),
            "base_ang_vel": [0.25 * rate for rate in qvel[3:6]],
            "command_ang_vel": [wanted.yaw_rate * walks],
            "command_base_height": [2.0 * wanted.height],
            "command_lin_vel": [wanted.vx * walks, wanted.vy * walks],
            "command_stand": [walks],
            "cos_phase": [float(np.cos(2 * np.pi * phase))],
            "dof_pos": [qpos[7 + joint] - default[joint] for joint in range(29)],
            "dof_vel": [0.05 * qvel[6 + joint] for joint in range(29)],
            "projected_gravity": compute_gravity(qpos),
            "ref_upper_dof_pos": upper,
            "sin_phase": [float(np.sin(2 * np.pi * phase))],
        }
        observation: list[float] = []
        for name in self.order[:9]:
            observation += now[name]
        for name in self.order:
            for frame in self._history[name]:  # newest first
                observation += frame
        for name in self.order[9:]:
            observation += now[name]
        seen = np.array(observation).astype(np.float32)
        for name in self.order:
            self._history[name] = [now[name], *self._history[name][:3]]
        self._steps += 1

        output = self._network(seen[None])
        self._action = np.clip(np.asarray(output, float).reshape(12), -100.0, 100.0)

        targets = np.zeros(29)
        for joint in LEGS:
            targets[joint] = LEG_DEFAULT[joint] + 0.25 * self._action[joint]
        targets[12:] = upper
        return Step(seen, clip_targets(targets) if self._clip else targets)


class PlainHomie:
    """HOMIE: velocities and height, 27 joints without waist roll and pitch; 76 x 6 numbers.

    Six whole frames, oldest first, the last of now; zeros before the start. Published code holds
    the waist at zero; here its three motors have the command, of which the network sees the yaw
    joint alone. There is no flag for standing: velocities of zero mean it.

    Args:
        network: See `Network`.
        clip: Whether targets are kept within the joint limits; the published code does not.
    """

    joints = (*range(13), *range(15, 29))

    def __init__(self, network: Network, clip: bool = False) -> None:
        self._network = network
        self._clip = clip
        self._action = np.zeros(12)
        self._frames = [[0.0] * 76 for _ in range(6)]

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run the network once. Shapes (36,), (35,), (7,), (14,)."""
        wanted = Command(*command)
        walks = 1.0 if mode == Mode.MOBILE else 0.0
        default = [*LEG_DEFAULT, *[0.0] * 17]
        frame: list[float] = [2.0 * wanted.vx * walks, 2.0 * wanted.vy * walks]
        frame += [0.25 * wanted.yaw_rate * walks, wanted.height]
        frame += [0.5 * rate for rate in qvel[3:6]]
        frame += compute_gravity(qpos)
        frame += [qpos[7 + joint] - default[joint] for joint in self.joints]
        frame += [0.05 * qvel[6 + joint] for joint in self.joints]
        frame += list(self._action)
        self._frames = [*self._frames[1:], frame]
        seen = np.array(self._frames).reshape(-1).astype(np.float32)

        output = self._network(seen[None])
        self._action = np.clip(np.asarray(output, float).reshape(12), -100.0, 100.0)

        targets = np.zeros(29)
        for joint in LEGS:
            targets[joint] = LEG_DEFAULT[joint] + 0.25 * self._action[joint]
        targets[WAIST_YAW] = wanted.waist_yaw
        targets[WAIST_ROLL] = wanted.waist_roll
        targets[WAIST_PITCH] = wanted.waist_pitch
        targets[ARMS] = arms
        return Step(seen, clip_targets(targets) if self._clip else targets)


class PlainHolosoma:
    """Holosoma's walker: three velocities, two clocks, all 29 joints its own; 100 numbers.

    Terms stand in alphabetical order; no history. The clock moves on *before* the network is
    shown it. Who stands has both feet at pi; who sets off after that begins at (0, pi), without
    a step of the clock in between. A robot that has never stood begins one step after (0, pi).
    Heights, waist angles and, unless they are taken from it, arm targets are not looked at.

    Args:
        network: See `Network`.
        take_arms: Whether the arms follow their targets instead of the network, which still
            remembers what it wanted of them.
        hide_arms: Whether the network is shown arms at rest in its default posture, as LeRobot's
            controller does.
        clip: Whether targets are kept within the joint limits; the published code does not.
        period: Of the gait [s].
    """

    default = np.array([-0.312, 0, 0, 0.669, -0.363, 0] * 2 + [0] * 3
                       + [0.2, 0.2, 0, 0.6, 0, 0, 0] + [0.2, -0.2, 0, 0.6, 0, 0, 0])  # fmt: skip

    def __init__(
        self,
        network: Network,
        take_arms: bool = False,
        hide_arms: bool = False,
        clip: bool = False,
        period: float = 1.0,
    ) -> None:
        self._network = network
        self._take_arms, self._hide_arms, self._clip = take_arms, hide_arms, clip
        self._advance = 2 * np.pi * DT / period
        self._action = np.zeros(29)
        self._phases = [0.0, np.pi]
        self._stood = False

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run the network once. Shapes (36,), (35,), (7,), (14,)."""
        wanted = Command(*command)
        walks = 1.0 if mode == Mode.MOBILE else 0.0
        vx, vy, yaw_rate = wanted.vx * walks, wanted.vy * walks, wanted.yaw_rate * walks
        self._phases = [
            float(np.fmod(phase + self._advance + np.pi, 2 * np.pi) - np.pi)
            for phase in self._phases
        ]
        if np.hypot(vx, vy) < 0.01 and abs(yaw_rate) < 0.01:
            self._phases = [np.pi, np.pi]
            self._stood = True
        elif self._stood:
            self._phases = [0.0, np.pi]
            self._stood = False

        angles = [qpos[7 + joint] - self.default[joint] for joint in range(29)]
        speeds = [0.05 * qvel[6 + joint] for joint in range(29)]
        if self._hide_arms:
            for joint in ARMS:
                angles[joint] = speeds[joint] = 0.0
        observation: list[float] = list(self._action)
        observation += [0.25 * rate for rate in qvel[3:6]]
        observation += [yaw_rate, vx, vy]
        observation += [float(np.cos(phase)) for phase in self._phases]
        observation += angles
        observation += speeds
        observation += compute_gravity(qpos)
        observation += [float(np.sin(phase)) for phase in self._phases]
        seen = np.array(observation).astype(np.float32)

        output = self._network(seen[None])
        self._action = np.clip(np.asarray(output, float).reshape(29), -100.0, 100.0)

        targets = self.default + 0.25 * self._action
        if self._take_arms:
            targets[ARMS] = arms
        return Step(seen, clip_targets(targets) if self._clip else targets)


class PlainGrootWbc:
    """GR00T's Balance and Walk: velocities, height, torso angles; legs and waist; 86 x 6 numbers.

    Six whole frames, oldest first, the last of now; zeros before the start. Both networks share
    the history and the last action, which is what the network said, not clipped. Balance runs
    while the three velocities together are shorter than 0.05, else Walk.

    Args:
        balance: Network that stands.
        walk: Network that walks.
        clip: Whether targets are kept within the joint limits; the published code does not.
        rate_scale: Of angular velocity and commanded yaw rate. NVIDIA's files say 0.5, LeRobot's
            controller 0.25.
    """

    def __init__(
        self, balance: Network, walk: Network, clip: bool = False, rate_scale: float = 0.5
    ) -> None:
        self._balance, self._walk = balance, walk
        self._clip = clip
        self._rate_scale = rate_scale
        self._action = np.zeros(15)
        self._frames = [[0.0] * 86 for _ in range(6)]

    def step(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        command: np.ndarray,
        arms: np.ndarray,
        mode: Mode,
    ) -> Step:
        """Run one of the networks once. Shapes (36,), (35,), (7,), (14,)."""
        wanted = Command(*command)
        walks = 1.0 if mode == Mode.MOBILE else 0.0
        vx, vy, yaw_rate = wanted.vx * walks, wanted.vy * walks, wanted.yaw_rate * walks
        default = [*LEG_DEFAULT, *[0.0] * 17]
        frame: list[float] = [2.0 * vx, 2.0 * vy, self._rate_scale * yaw_rate, wanted.height]
        frame += [wanted.waist_roll, wanted.waist_pitch, wanted.waist_yaw]
        frame += [self._rate_scale * rate for rate in qvel[3:6]]
        frame += compute_gravity(qpos)
        frame += [qpos[7 + joint] - default[joint] for joint in range(29)]
        frame += [0.05 * qvel[6 + joint] for joint in range(29)]
        frame += list(self._action)
        self._frames = [*self._frames[1:], frame]
        seen = np.array(self._frames).reshape(-1).astype(np.float32)

        stands = np.sqrt(vx**2 + vy**2 + yaw_rate**2) < 0.05
        output = (self._balance if stands else self._walk)(seen[None])
        self._action = np.asarray(output, float).reshape(15)

        targets = np.zeros(29)
        targets[:15] = np.array(default[:15]) + 0.25 * self._action
        targets[ARMS] = arms
        return Step(seen, clip_targets(targets) if self._clip else targets)
