r"""The teacher of G1's student: FALCON where the robot steps, a balance controller where it stands.

FALCON loses its footing below 0.55 m, does not lean, and is disturbed by the arms. Standing on two
planted feet needs no learning: with the true state and the model, which a teacher in simulation may
use, the required contact wrench follows from springs and dampers, and the legs' torques from their
Jacobians. `Balance` computes them. `Teacher` uses it while the robot can recover without a step,
and FALCON with calm arms otherwise. Both are (nearly) functions of the present state, so that a
network that sees five frames can imitate them. Lengths are in m, angles in rad, times in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import quat_rotate, quat_yaw
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.low_level.tables import load_policy
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model

JOINTS = read_joints("g1")
ARMS = slice(JOINTS.arms[0], JOINTS.arms[-1] + 1)
ACTIONS = slice(0, len(JOINTS.names))
"""Entries of the last action in the memories of student and FALCON."""
ACTION_SCALE = 0.25
"""Joint angle per unit of action in both policies' tables [rad]."""
LEGS, WAIST = slice(0, 12), slice(12, 15)
LEG = 6
"""Number of joints of a leg."""
COMMANDED_WAIST, PITCH, VELOCITIES = slice(1, 4), 3, slice(4, 7)
"""Entries of the command."""
LEAN_FROM, MAX_LEAN = 0.5, 0.5
"""Commanded pitch above which the pelvis leans too, and its maximum lean [rad]."""

GRAVITY = 9.81
SOLE = np.array([0.035, 0.0, -0.035])
"""Centre of the sole in the frame of the ankle roll link [m]."""
HALF_LENGTH, HALF_WIDTH = 0.078, 0.023
"""Maximum distance of the centre of pressure from it [m]; a little inside the contact spheres,
which are at 0.085 and 0.025 to 0.03."""
TWIST = 0.03
"""Maximum moment about the vertical on a foot, per vertical force [m]."""


MAX_SWAY = np.array([0.036, 0.024])
"""Maximum weight shift (displacement of the centre of mass), forward and left [m]."""
SWAY_S = 0.24
"""Weight shift per commanded velocity in stance [s]."""


class Measured(NamedTuple):
    """Quantities of each robot that the balance needs, in the world frame.

    Attributes:
        com: Centre of mass [m]. Shape (n, 3).
        com_velocity: Velocity of the centre of mass [m/s]. Shape (n, 3).
        upper: Centre of mass of everything but the legs [m]. Shape (n, 3).
        soles: Centres of the left and right sole [m]. Shape (n, 2, 3).
        feet: Rotation matrix of each foot. Shape (n, 2, 3, 3).
        sole_velocity: Velocity of each sole's centre [m/s]. Shape (n, 2, 3).
        jacobian: Jacobian of each sole's centre with respect to its leg's joints, linear rows
            first. Shape (n, 2, 6, 6).
        gravity: Joint torques that compensate gravity [N m]. Shape (n, 29).
        hands: Points of application of forces on the hands [m]. Shape (n, 2, 3).
    """

    com: np.ndarray
    com_velocity: np.ndarray
    upper: np.ndarray
    soles: np.ndarray
    feet: np.ndarray
    sole_velocity: np.ndarray
    jacobian: np.ndarray
    gravity: np.ndarray
    hands: np.ndarray


class Body:
    """G1's planning model, on which `Measured` quantities are computed robot by robot."""

    def __init__(self) -> None:
        model = self._model = build_model(make_morphology("g1"), "planning")
        self.stiffness = model.actuator_gainprm[:, 0].copy()
        self.damping = -model.actuator_biasprm[:, 2].copy()
        self.torque = model.actuator_forcerange[:, 1].copy()
        self.mass = float(model.body_mass.sum())
        self._data = mujoco.MjData(model)
        sides = ("left", "right")
        self._feet = [model.body(f"{side}_ankle_roll_link").id for side in sides]
        self._hands = [model.body(f"{side}_wrist_yaw_link").id for side in sides]
        self._legs = [model.body(f"{side}_hip_pitch_link").id for side in sides]
        self._leg_mass = float(model.body_subtreemass[self._legs[0]])

    def measure(self, qpos: np.ndarray, qvel: np.ndarray) -> Measured:
        """Compute the quantities of n robots from qpos (n, 36) and qvel (n, 35)."""
        n, model, data = len(qpos), self._model, self._data
        shapes = ((3,), (3,), (3,), (2, 3), (2, 3, 3), (2, 3), (2, 6, LEG), (model.nu,), (2, 3))
        out = Measured(*(np.empty((n, *shape)) for shape in shapes))
        jacobian, force = np.empty((6, model.nv)), np.empty(model.nv)
        linear, angular = jacobian[:3], jacobian[3:]
        data.qvel[:] = 0.0  # inverse dynamics at rest gives the torques of gravity alone
        for i in range(n):
            data.qpos[:] = qpos[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, force)
            out.gravity[i] = force[6:]
            out.com[i] = data.subtree_com[0]
            mujoco.mj_jacSubtreeCom(model, data, linear, 0)
            out.com_velocity[i] = linear @ qvel[i]
            out.upper[i] = self._leg_mass * data.subtree_com[self._legs].sum(0)
            for side, body in enumerate(self._feet):
                out.feet[i, side] = data.xmat[body].reshape(3, 3)
                out.soles[i, side] = data.xpos[body] + out.feet[i, side] @ SOLE
                mujoco.mj_jac(model, data, linear, angular, out.soles[i, side], body)
                out.sole_velocity[i, side] = linear @ qvel[i]
                out.jacobian[i, side] = jacobian[:, 6 + LEG * side :][:, :LEG]
            out.hands[i] = data.xipos[self._hands]
        upper = (self.mass * out.com - out.upper) / (self.mass - 2 * self._leg_mass)
        return out._replace(upper=upper)


@dataclass(frozen=True)
class BalanceGains:
    """Gains of the balance.

    Attributes:
        capture: Lead of the centre of pressure over the capture point, per error of the latter
            [1].
        height: Vertical acceleration per height error of the pelvis [1/s^2].
        height_rate: Vertical deceleration per vertical velocity of the pelvis [1/s].
        height_error: Saturation of the height error [m]; limits the speed of a squat.
        turn: Angular acceleration per orientation error of the pelvis [1/s^2].
        turn_rate: Angular deceleration per angular velocity of the pelvis [1/s].
        inertia: Effective inertia of the pelvis about X, Y, Z of the heading frame [kg m^2].
        moment: Maximum moment that rotates the pelvis [N m].
    """

    capture: float = 2.0
    height: float = 80.0
    height_rate: float = 16.0
    height_error: float = 0.1
    turn: float = 100.0
    turn_rate: float = 16.0
    inertia: tuple[float, float, float] = (1.2, 1.2, 0.3)
    moment: float = 25.0


class Balanced(NamedTuple):
    """Output of the balance, and the quantities that decide whether it can act.

    Attributes:
        targets: Joint targets of the legs [rad]. Shape (n, 12).
        capture: Capture point from the midpoint of the feet, heading frame [m]. Shape (n, 2).
        error: Capture point from its desired position, heading frame [m]. Shape (n, 2).
        half_width: Half the width of the support [m]. Shape (n,).
        soles: Centres of the soles from their midpoint, heading frame [m]. Shape (n, 2, 3).
        tilt: Orientation error of the pelvis, heading frame [rad]. Shape (n, 3).
        pitch: Pitch of the pelvis [rad]. Shape (n,).
    """

    targets: np.ndarray
    capture: np.ndarray
    error: np.ndarray
    half_width: np.ndarray
    soles: np.ndarray
    tilt: np.ndarray
    pitch: np.ndarray


class Balance:
    r"""Balance controller for two planted feet at any placement.

    The desired contact wrench carries the weight, drives the pelvis to its height and orientation
    by springs and dampers, and puts the centre of pressure beyond the capture point
    :math:`\xi = c + \dot c / \omega`, so that the latter returns to the midpoint of the feet. The
    robot leans against forces on its hands. The feet share the wrench according to the centre of
    pressure between them; the legs' torques are :math:`\tau = g - \sum J_i^T f_i`. The servos'
    targets :math:`q + (\tau + k_d \dot q) / k_p` compensate the servos' damping, without which a
    squat would tip the robot forward.

    Args:
        gains: Gains; None for the defaults.
    """

    def __init__(self, gains: BalanceGains | None = None) -> None:
        self.body, self.gains = Body(), gains or BalanceGains()

    def compute(
        self,
        qpos: np.ndarray,
        qvel: np.ndarray,
        measured: Measured,
        height: np.ndarray,
        lean: np.ndarray,
        sway: np.ndarray,
        force: np.ndarray,
    ) -> Balanced:
        """Compute the joint targets of the legs.

        Args:
            qpos: Generalised positions. Shape (n, 36).
            qvel: Generalised velocities. Shape (n, 35).
            measured: Quantities of the same robots.
            height: Desired height of the pelvis above the soles [m]. Shape (n,).
            lean: Desired pitch of the pelvis [rad]. Shape (n,).
            sway: Desired weight shift, forward and left [m]. Shape (n, 2).
            force: Forces on the hands, world [N]. Shape (n, 2, 3).
        """
        gains, mass, n = self.gains, self.body.mass, len(qpos)
        frame = _compute_heading_frame(measured.feet)

        def turn(vectors: np.ndarray) -> np.ndarray:
            return np.einsum("nij,n...j->n...i", frame, vectors)

        middle = measured.soles.mean(1)
        com, velocity = turn(measured.com - middle), turn(measured.com_velocity)
        soles = turn(measured.soles - middle[:, None])
        hands, push = turn(measured.hands - middle[:, None]), turn(force)
        pelvis = frame @ _compute_matrix(qpos[:, 3:7])

        # Vertical load on the feet, and the centre of pressure if the robot were at rest.
        weight = mass * GRAVITY
        load = np.maximum(weight - push[..., 2].sum(1), 0.5 * weight)
        at_rest = weight * com[:, :2] - (push[..., 2:] * hands[..., :2]).sum(1)
        at_rest = (at_rest + (push[..., :2] * hands[..., 2:]).sum(1)) / load[:, None]
        omega = np.sqrt(GRAVITY / np.maximum(com[:, 2], 0.3))[:, None]
        aim = np.clip(sway, -MAX_SWAY, MAX_SWAY)
        aim[:, 0] = np.maximum(aim[:, 0], -MAX_SWAY[0] * compute_back_share(height))
        aim[:, 0] += compute_heel_shift(height)
        capture = at_rest + velocity[:, :2] / omega

        upper = np.einsum("nji,nj->ni", pelvis, turn(measured.upper - qpos[:, :3]))
        lean = np.maximum(lean, compute_least_lean(height, upper, mass))
        tilt = _compute_rotation_error(lean, pelvis)
        spin = np.einsum("nij,nj->ni", pelvis, qvel[:, 3:6])
        moment = gains.inertia * (gains.turn * tilt - gains.turn_rate * spin)
        moment = np.clip(moment, -gains.moment, gains.moment)

        error = height - (qpos[:, 2] - middle[:, 2])
        error = np.clip(error, -gains.height_error, gains.height_error)
        lift = load + mass * (gains.height * error - gains.height_rate * qvel[:, 2])
        lift = np.clip(lift, 0.5 * load, 1.5 * load)
        half_width = 0.5 * np.abs(soles[:, 0, 1] - soles[:, 1, 1]) + HALF_WIDTH
        bound = np.stack([np.full(n, HALF_LENGTH), half_width], axis=1)
        pressure = np.clip(capture + gains.capture * (capture - aim), -bound, bound)
        along = mass * omega**2 * (at_rest - pressure) - push[..., :2].sum(1)

        total = np.concatenate([along, lift[:, None]], axis=1)
        torque = moment.copy()  # about the midpoint of the feet
        torque[:, 0] += pressure[:, 1] * lift
        torque[:, 1] -= pressure[:, 0] * lift
        forces, torques = _share(soles, total, torque)
        wrench = np.concatenate([forces, torques], axis=2)  # heading frame
        wrench = np.einsum("nji,nskj->nski", frame, wrench.reshape(n, 2, 2, 3)).reshape(n, 2, 6)
        bear = measured.gravity[:, LEGS].reshape(n, 2, LEG)
        tau = bear - np.einsum("nsij,nsi->nsj", measured.jacobian, wrench)
        body = self.body
        tau = np.clip(tau.reshape(n, 2 * LEG), -body.torque[LEGS], body.torque[LEGS])
        tau += body.damping[LEGS] * qvel[:, 6:18]
        targets = qpos[:, 7:19] + tau / body.stiffness[LEGS]
        pitch = -np.arcsin(np.clip(pelvis[:, 2, 0], -1, 1))
        return Balanced(targets, capture, capture - aim, half_width, soles, tilt, pitch)


def compute_back_share(height: np.ndarray) -> np.ndarray:
    """Return the possible fraction of a backward weight shift: low, the heels are near. (n,)."""
    return np.clip((height - 0.5) / 0.2, 0, 1)


def compute_heel_shift(height: np.ndarray) -> np.ndarray:
    """Return the desired centre of pressure ahead of the midpoint of the feet [m]. Shape (n,).

    Low, the shins cannot tilt far enough to keep it at the midpoint.
    """
    return -0.01 * np.clip((0.6 - height) / 0.15, 0, 1)


HIP, ANKLE = 0.1027, 0.0526
"""Height of the pelvis above the hips and of the ankles above the ground [m]."""
THIGH, SHIN = 0.3367, 0.3
"""Lengths in the sagittal plane [m]."""
LEG_MASSES = (4.572, 1.932, 0.682)
"""Masses of a thigh, shin and foot [kg]."""
LEG_CENTRES = (0.478, 0.4, 0.024)
"""Their centres of mass: fraction of the thigh from the hip, fraction of the shin from the knee,
and distance of the foot's ahead of the ankle [m]."""
ANKLE_LIMIT = -0.82
"""Minimum ankle pitch that is used [rad], with a margin to the joint's limit of -0.873."""


def compute_least_lean(height: np.ndarray, upper: np.ndarray, mass: float) -> np.ndarray:
    """Compute the minimum pitch of the pelvis at which the robot can balance at a height.

    Low, the hips are behind the feet, and the ankles' limit ends the shins' tilt; the trunk then
    has to lean. Computed in the sagittal plane with parallel feet: for each pitch on a grid the
    hips are placed by five fixed-point steps so that the centre of mass is above its desired
    position, and the pitch at which the ankles reach their limit is interpolated.

    Args:
        height: Height of the pelvis [m]. Shape (n,).
        upper: Centre of mass of everything but the legs, in the pelvis's frame [m]. Shape (n, 3).
        mass: Mass of the whole robot [kg].

    Returns:
        Pitch, 0 to 0.7 rad. Shape (n,).
    """
    step = 0.05
    pitch = np.arange(0.0, 0.71, step)[:, None]
    trunk = np.cos(pitch) * upper[:, 0] + np.sin(pitch) * upper[:, 2] + HIP * np.sin(pitch)
    drop = height - HIP * np.cos(pitch) - ANKLE
    thigh, shin, foot = LEG_MASSES
    aim = SOLE[0] + compute_heel_shift(height)
    hip = np.zeros_like(trunk)  # distance ahead of the ankle [m]
    for _ in range(5):
        tilt = _compute_shin_tilt(hip, drop)
        knee = SHIN * np.sin(tilt)
        com = (mass - 2 * sum(LEG_MASSES)) * (hip + trunk)
        com += 2 * thigh * (hip + LEG_CENTRES[0] * (knee - hip))
        com += 2 * (shin * (1 - LEG_CENTRES[1]) * knee + foot * LEG_CENTRES[2])
        hip += aim - com / mass
    lack = _compute_shin_tilt(hip, drop) + ANKLE_LIMIT  # positive beyond the ankles' limit
    first = np.where((lack <= 0).any(0), (lack <= 0).argmax(0), len(pitch) - 1)
    robots, before = np.arange(len(height)), np.maximum(first - 1, 0)
    more, less = lack[before, robots], lack[first, robots]
    share = np.clip(more / np.maximum(more - less, 1e-6), 0, 1)
    return np.where(first > 0, step * (before + share), 0.0)


def _compute_shin_tilt(hip: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """Compute the shins' forward tilt for hips `hip` ahead of and `drop` above the ankles [rad]."""
    length = np.clip(np.hypot(hip, drop), 0.1, THIGH + SHIN - 1e-3)
    cos = (SHIN**2 + length**2 - THIGH**2) / (2 * SHIN * length)
    return np.arctan2(hip, drop) + np.arccos(np.clip(cos, -1, 1))


def compute_lean(command: np.ndarray) -> np.ndarray:
    """Return the pelvis's part of the commanded pitch: the part beyond the waist's range [rad].

    Shapes (n, 7) -> (n,).
    """
    return np.clip(command[:, PITCH] - LEAN_FROM, 0.0, MAX_LEAN)


def compute_velocity(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Compute the velocity in the heading frame: vx, vy [m/s], yaw rate [rad/s]. Shape (n, 3)."""
    yaw = quat_yaw(qpos[:, 3:7])
    cos, sin = np.cos(yaw), np.sin(yaw)
    vx, vy = qvel[:, 0], qvel[:, 1]
    turn = quat_rotate(qpos[:, 3:7], qvel[:, 3:6])[:, 2]
    return np.stack([cos * vx + sin * vy, cos * vy - sin * vx, turn], axis=1)


def _compute_matrix(quat: np.ndarray) -> np.ndarray:
    """Convert quaternions wxyz to rotation matrices. Shape (n, 4) -> (n, 3, 3)."""
    return np.stack([quat_rotate(quat, axis) for axis in np.eye(3)], axis=2)


def _compute_heading_frame(feet: np.ndarray) -> np.ndarray:
    """Compute the rotation from world to the feet's mean heading. (n, 2, 3, 3) -> (n, 3, 3)."""
    along = feet[..., :2, 0].sum(1)
    cos, sin = (along / np.linalg.norm(along, axis=1, keepdims=True)).T
    frame = np.zeros((len(feet), 3, 3))
    frame[:, 0, 0] = frame[:, 1, 1] = cos
    frame[:, 0, 1], frame[:, 1, 0], frame[:, 2, 2] = sin, -sin, 1.0
    return frame


def _compute_rotation_error(lean: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Compute the rotation vector from `pelvis` to pure pitch `lean`, for small errors. (n, 3)."""
    wanted = np.zeros_like(pelvis)
    wanted[:, 0, 0] = wanted[:, 2, 2] = np.cos(lean)
    wanted[:, 0, 2] = np.sin(lean)
    wanted[:, 2, 0], wanted[:, 1, 1] = -wanted[:, 0, 2], 1.0
    error = wanted @ pelvis.transpose(0, 2, 1)
    error = error - error.transpose(0, 2, 1)
    return 0.5 * np.stack([error[:, 2, 1], error[:, 0, 2], error[:, 1, 0]], axis=1)


def _share(
    soles: np.ndarray, force: np.ndarray, torque: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distribute a wrench about the midpoint of the feet between the two soles.

    The forces are parallel; the residual torque is limited to what each sole can bear.

    Args:
        soles: Centres of the soles from their midpoint [m]. Shape (n, 2, 3).
        force: Force of the wrench [N]. Shape (n, 3).
        torque: Torque of the wrench [N m]. Shape (n, 3).

    Returns:
        Forces and torques at the centres of the soles. Shapes (n, 2, 3).
    """
    spread = np.maximum(soles[:, 0, 1] - soles[:, 1, 1], 0.05)
    left = np.clip((torque[:, 0] / force[:, 2] - soles[:, 1, 1]) / spread, 0.03, 0.97)
    shares = np.stack([left, 1 - left], axis=1)[..., None]
    forces = shares * force[:, None]
    remains = torque - np.cross(soles, forces).sum(1)
    limit = forces[..., 2:] * np.array([HALF_WIDTH, HALF_LENGTH, TWIST])
    return forces, np.clip(shares * remains[:, None], -limit, limit)


@dataclass(frozen=True)
class Handover:
    """Conditions under which the balance acts, and otherwise FALCON.

    Attributes:
        hold: Fraction of the support within which the capture point must stay for the balance to
            go on [1].
        take: Fraction of the support within which the capture point's error must be for the
            balance to take over [1].
        flat: Maximum tilt of a planted foot [rad].
        clear: Maximum height of a planted sole's centre above the ground [m].
        still: Maximum speed of the soles when the balance takes over [m/s].
        spread: Minimum and maximum lateral distance of the feet then [m].
        stagger: Maximum distance of the feet along the heading then [m].
        sinks: Pelvis height below which a robot commanded to walk stands up first [m].
        stands: Pelvis height above which, once standing up, it walks [m].
        leans: Pitch of the pelvis above which a robot commanded to walk stands up first; below
            half of it, it walks [rad].
        blend_s: Time in which the balance takes over [s].
        yield_s: Time in which FALCON takes over [s].
    """

    hold: float = 1.0
    take: float = 0.6
    flat: float = 0.15
    clear: float = 0.012
    still: float = 0.2
    spread: tuple[float, float] = (0.13, 0.42)
    stagger: float = 0.25
    sinks: float = 0.62
    stands: float = 0.68
    leans: float = 0.2
    blend_s: float = 0.2
    yield_s: float = 0.06


STEP_HEIGHT, WALK_HEIGHT = 0.62, 0.68
"""Minimum heights commanded to FALCON while it stands and while it walks [m]; lower, it loses its
footing."""
RISE = 0.73
"""Height to which a low robot rises before it walks [m]."""
TRIM = np.array([0.06, 0.03, -0.06])
"""Offset of the velocity commanded to FALCON, against its drift: vx, vy [m/s], yaw rate [rad/s]."""
FEEDBACK = np.array([1.5, 1.5, 0.7])
"""Feedback gains of the velocity commanded to FALCON on the velocity error [1]; higher gains make
the body's yaw oscillate."""
MAX_ERROR = 0.5
"""Saturation of the velocity error [m/s, rad/s]."""
SUPPORT = 0.08
"""Half the length of the support [m]."""


class Taught(NamedTuple):
    """Output of the teacher.

    Attributes:
        targets: Motor targets [rad]. Shape (n, 29).
        actions: Network outputs that give the same targets. Shape (n, 29).
        memory: FALCON's memory after the step. Shape (n, nm).
        share: Weight of the balance against FALCON, 0 to 1. Shape (n,).
    """

    targets: np.ndarray
    actions: np.ndarray
    memory: np.ndarray
    share: np.ndarray


class Teacher:
    """The teacher: a blend of FALCON and `Balance`.

    The arms' actions compensate gravity on their soft servos, computed from the model, since
    FALCON does so only in the postures that it was trained with.

    Args:
        path: FALCON's ONNX file; None for the cached or downloaded one.
        gains: Gains of the balance; None for the defaults.
        handover: Conditions under which the balance acts; None for the defaults.
    """

    def __init__(
        self,
        path: str | None,
        gains: BalanceGains | None = None,
        handover: Handover | None = None,
    ) -> None:
        self.falcon, self.balance = load_policy("falcon", path), Balance(gains)
        self.handover = handover or Handover()
        network = self.falcon.table.networks["whole_body"]
        self._centre = JOINTS.spread(network.default, 0.0)

    def initial_memory(self, n: int) -> np.ndarray:
        """Return FALCON's initial memory. Shape (n, nm)."""
        return self.falcon.initial_memory(n)

    def teach(
        self,
        true: tuple[np.ndarray, np.ndarray],
        sensed: tuple[np.ndarray, np.ndarray],
        command: np.ndarray,
        arms: np.ndarray,
        memory: np.ndarray,
        mode: np.ndarray,
        force: np.ndarray,
        share: np.ndarray,
    ) -> Taught:
        """Compute motor targets for the next policy step of 20 ms.

        Args:
            true: Generalised positions and velocities. Shapes (n, 36), (n, 35).
            sensed: The same with sensor noise, as the student sees them.
            command: Commands. Shape (n, 7).
            arms: Arm targets [rad]. Shape (n, 14).
            memory: FALCON's memory, with the executed actions as its last. Shape (n, nm).
            mode: Mode of each robot. Shape (n,).
            force: Forces on the hands, world [N]. Shape (n, 2, 3).
            share: The previous `Taught.share`; zero at first. Shape (n,).
        """
        qpos, qvel = true
        walks = mode == Mode.MOBILE
        measured = self.balance.body.measure(qpos, qvel)
        height = np.where(walks, RISE, command[:, 0])
        lean = np.where(walks, 0.0, compute_lean(command))
        sway = np.where(walks[:, None], 0.0, SWAY_S * command[:, VELOCITIES][:, :2])
        balanced = self.balance.compute(qpos, qvel, measured, height, lean, sway, force)
        acts = self._decide(qpos, measured, balanced, walks, share > 0)
        rules = self.handover
        share = share + POLICY_DT * np.where(acts, 1 / rules.blend_s, -1 / rules.yield_s)
        share = np.clip(share, 0, 1)

        told = self._tell(command, walks, compute_velocity(qpos, qvel))
        # The measured angles serve as arm targets: obstructed arms would disturb FALCON.
        where = sensed[0][:, JOINTS.positions][:, ARMS]
        _, after = self.falcon.act(*sensed, told, where, memory, mode)
        own = np.zeros((len(qpos), len(JOINTS.names)))
        own[:, LEGS] = balanced.targets
        own[:, WAIST] = command[:, COMMANDED_WAIST]
        own = (np.clip(own, JOINTS.low, JOINTS.high) - self._centre) / ACTION_SCALE
        own[:, WAIST.start + 1 : WAIST.stop] = 0.0  # roll and pitch follow the command directly
        actions = after[:, ACTIONS]
        actions += share[:, None] * (own - actions)
        actions[:, ARMS] = (measured.gravity / JOINTS.stiffness)[:, ARMS] / ACTION_SCALE
        targets = self._centre + ACTION_SCALE * actions
        targets[:, WAIST.start + 1 : WAIST.stop] = command[:, COMMANDED_WAIST][:, 1:]
        targets[:, ARMS] += arms
        return Taught(np.clip(targets, JOINTS.low, JOINTS.high), actions.copy(), after, share)

    def _tell(self, command: np.ndarray, walks: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Compute FALCON's command: raised heights, and velocities with feedback. Shape (n, 7)."""
        told = command.copy()
        np.maximum(told[:, 0], np.where(walks, WALK_HEIGHT, STEP_HEIGHT), out=told[:, 0])
        wanted = np.where(walks[:, None], command[:, VELOCITIES], 0.0)
        error = np.clip(wanted - velocity, -MAX_ERROR, MAX_ERROR)
        told[:, VELOCITIES] = wanted + FEEDBACK * error + np.where(walks[:, None], TRIM, 0.0)
        return told

    def _decide(
        self,
        qpos: np.ndarray,
        measured: Measured,
        balanced: Balanced,
        walks: np.ndarray,
        acted: np.ndarray,
    ) -> np.ndarray:
        """Decide for which robots the balance acts now. Shape (n,), bool.

        Args:
            qpos: Generalised positions. Shape (n, 36).
            measured: Quantities of the robots.
            balanced: Output of the balance.
            walks: Whether each robot is commanded to walk. Shape (n,).
            acted: Whether the balance acted in the last step; gives hysteresis. Shape (n,).
        """
        rules, soles = self.handover, measured.soles
        clear = np.abs(soles[..., 2]).max(1) < rules.clear
        flat = (measured.feet[..., 2, 2] > np.cos(rules.flat)).all(1)
        across, along = np.abs(balanced.soles[:, 0] - balanced.soles[:, 1])[:, 1::-1].T
        apart = (across > rules.spread[0]) & (across < rules.spread[1]) & (along < rules.stagger)
        still = np.linalg.norm(measured.sole_velocity, axis=2).max(1) < rules.still
        support = np.stack([np.full(len(qpos), SUPPORT), balanced.half_width], axis=1)
        out, off = ((np.abs(at) / support).max(1) for at in (balanced.capture, balanced.error))
        planted = clear & flat
        height, lean = qpos[:, 2] - soles.mean(1)[:, 2], balanced.pitch
        low = np.where(acted, height < rules.stands, height < rules.sinks)
        leans = lean > np.where(acted, 0.5 * rules.leans, rules.leans)
        stands_up = ~walks | low | leans
        holds = planted & (out < rules.hold)
        takes = planted & apart & still & (out < 0.9) & (off < rules.take)
        return np.where(acted, holds, takes) & stands_up
