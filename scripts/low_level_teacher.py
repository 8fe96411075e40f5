r"""The teacher of G1's student: FALCON where the robot steps, a balance of our own where it stands.

FALCON loses its footing below 0.55 m, does not lean, and minds the arms. Standing on two planted
feet needs no learning: where the true state and the model are known, as a teacher in simulation
may know them, the wrench that the feet must bear follows from a few springs, and the legs'
torques from their Jacobians. `Balance` computes them; `Teacher` lets it act as long as the robot
can be caught without a step, and FALCON, with calm arms, otherwise. Both are (nearly) functions
of the present state, so that a network that sees five frames can imitate them.
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
"""Last outputs in the memory of student and FALCON."""
ACTION_SCALE = 0.25
"""Of both tables."""
LEGS, WAIST = slice(0, 12), slice(12, 15)
LEG = 6
"""Joints of a leg."""
COMMANDED_WAIST, PITCH, VELOCITIES = slice(1, 4), 3, slice(4, 7)
"""Entries of the command."""
LEAN_FROM, MAX_LEAN = 0.5, 0.5
"""A pitch beyond the first is for the pelvis, up to the second [rad]."""

GRAVITY = 9.81
SOLE = np.array([0.035, 0.0, -0.035])
"""Middle of the sole in the ankle roll link [m]."""
HALF_LENGTH, HALF_WIDTH = 0.078, 0.023
"""How far from it the centre of pressure may go [m]; the contact spheres: 0.085, 0.025 to 0.03."""
TWIST = 0.03
"""Largest moment about the vertical that a foot bears, over its load [m]."""


MAX_SWAY = np.array([0.036, 0.024])
"""Largest shift of the centre of mass, forward and left [m]."""
SWAY_S = 0.24
"""Shift of the centre of mass for a velocity that a standing robot is told [s]."""


class Measured(NamedTuple):
    """What the balance needs to know of each robot; world frame.

    Attributes:
        com: Centre of mass [m]. Shape (n, 3).
        com_velocity: Its velocity [m/s]. Shape (n, 3).
        upper: Centre of mass of all but the legs [m]. Shape (n, 3).
        soles: Middle of the left and right sole [m]. Shape (n, 2, 3).
        feet: Rotation of each foot. Shape (n, 2, 3, 3).
        sole_velocity: Velocity of each sole's middle [m/s]. Shape (n, 2, 3).
        jacobian: Linear, then angular velocity of each sole by its leg's joints.
            Shape (n, 2, 6, 6).
        gravity: Torques that bear the links' weight [N m]. Shape (n, 29).
        hands: Where forces on the hands act [m]. Shape (n, 2, 3).
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
    """The planning model, on which robots are measured one after the other."""

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
        """Measure robots. Shapes (n, 36), (n, 35)."""
        n, model, data = len(qpos), self._model, self._data
        shapes = ((3,), (3,), (3,), (2, 3), (2, 3, 3), (2, 3), (2, 6, LEG), (model.nu,), (2, 3))
        out = Measured(*(np.empty((n, *shape)) for shape in shapes))
        jacobian, force = np.empty((6, model.nv)), np.empty(model.nv)
        linear, angular = jacobian[:3], jacobian[3:]
        data.qvel[:] = 0.0  # the torques of a robot at rest: gravity alone
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
    """Springs and dampers of the balance.

    Attributes:
        capture: How far the centre of pressure leads the capture point, over the latter's
            error [1].
        height: Acceleration for the pelvis's error of height [1/s^2].
        height_rate: And for its speed [1/s].
        height_error: Largest such error that counts [m]; limits the speed of a squat.
        turn: Angular acceleration for the pelvis's error of orientation [1/s^2].
        turn_rate: And for its angular velocity [1/s].
        inertia: About X, Y, Z of the heading frame [kg m^2].
        moment: Largest moment that turns the pelvis [N m].
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
    """What the balance would do, and whether it can.

    Attributes:
        targets: Targets of the legs [rad]. Shape (n, 12).
        capture: Where the capture point is, from the middle of the feet, heading frame [m].
            Shape (n, 2).
        error: The same, from where it shall be [m]. Shape (n, 2).
        half_width: Half of the support's width [m]. Shape (n,).
        soles: Middle of the soles from their common middle, heading frame [m]. Shape (n, 2, 3).
        tilt: Error of the pelvis's orientation, heading frame [rad]. Shape (n, 3).
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
    r"""Balance on two planted feet, wherever they stand.

    The wanted wrench on the feet: bear the weight, bring the pelvis to its height and its
    orientation by springs, and put the centre of pressure beyond the capture point
    :math:`\xi = c + \dot c / \omega`, so that it returns to the middle of the feet. Forces on the
    hands are borne by leaning against them. The feet share the wrench by where the centre of
    pressure is between them, and :math:`\tau = g - \sum J_i^T f_i` are the torques of the legs.
    The servos' targets are :math:`q + (\tau + k_d \dot q) / k_p`: the servos' damping of joints is
    made up for, or else a squat would throw the robot on its nose.
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
        """Compute the targets of the legs.

        Args:
            qpos: Generalised positions. Shape (n, 36).
            qvel: Generalised velocities. Shape (n, 35).
            measured: The same robots, measured.
            height: Wanted height of the pelvis over the soles [m]. Shape (n,).
            lean: Wanted pitch of the pelvis [rad]. Shape (n,).
            sway: Wanted shift of the centre of mass, forward and left [m]. Shape (n, 2).
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

        # The load on the feet, and where it would act if the robot stood still as it is.
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
        torque = moment.copy()  # about the middle of the feet
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
    """How much of the sway backwards there is room for: low, the heels are near."""
    return np.clip((height - 0.5) / 0.2, 0, 1)


def compute_heel_shift(height: np.ndarray) -> np.ndarray:
    """Where the centre of pressure shall be, before the middle of the feet [m].

    Low, the shins cannot tilt enough to keep it in the middle.
    """
    return -0.01 * np.clip((0.6 - height) / 0.15, 0, 1)


HIP, ANKLE = 0.1027, 0.0526
"""Height of the pelvis over the hips and of the ankles over the ground [m]."""
THIGH, SHIN = 0.3367, 0.3
"""Lengths in the sagittal plane [m]."""
LEG_MASSES = (4.572, 1.932, 0.682)
"""Masses of a thigh, shin and foot [kg]."""
LEG_CENTRES = (0.478, 0.4, 0.024)
"""Their centres: shares of the thigh from the hip and of the shin from the knee; before the
ankle [m]."""
ANKLE_LIMIT = -0.82
"""Where an ankle's pitch is kept [rad]; it ends at -0.873."""


def compute_least_lean(height: np.ndarray, upper: np.ndarray, mass: float) -> np.ndarray:
    """Compute the least pitch of the pelvis with which the robot can be so low.

    Low, the hips are behind the feet, and the shins' tilt ends at the ankles' limit; the trunk
    then has to lean. In the sagittal plane, feet side by side.

    Args:
        height: Height of the pelvis [m]. Shape (n,).
        upper: Centre of mass of all but the legs, in the pelvis [m]. Shape (n, 3).
        mass: Of the whole robot [kg].

    Returns:
        Pitch, 0 to 0.7 rad. Shape (n,).
    """
    step = 0.05
    pitch = np.arange(0.0, 0.71, step)[:, None]
    trunk = np.cos(pitch) * upper[:, 0] + np.sin(pitch) * upper[:, 2] + HIP * np.sin(pitch)
    drop = height - HIP * np.cos(pitch) - ANKLE
    thigh, shin, foot = LEG_MASSES
    aim = SOLE[0] + compute_heel_shift(height)
    hip = np.zeros_like(trunk)  # before the ankle
    for _ in range(5):
        tilt = _compute_shin_tilt(hip, drop)
        knee = SHIN * np.sin(tilt)
        com = (mass - 2 * sum(LEG_MASSES)) * (hip + trunk)
        com += 2 * thigh * (hip + LEG_CENTRES[0] * (knee - hip))
        com += 2 * (shin * (1 - LEG_CENTRES[1]) * knee + foot * LEG_CENTRES[2])
        hip += aim - com / mass
    lack = _compute_shin_tilt(hip, drop) + ANKLE_LIMIT  # positive: too much for the ankles
    first = np.where((lack <= 0).any(0), (lack <= 0).argmax(0), len(pitch) - 1)
    robots, before = np.arange(len(height)), np.maximum(first - 1, 0)
    more, less = lack[before, robots], lack[first, robots]
    share = np.clip(more / np.maximum(more - less, 1e-6), 0, 1)
    return np.where(first > 0, step * (before + share), 0.0)


def _compute_shin_tilt(hip: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """Forward tilt of the shins for hips `hip` before and `drop` above the ankles [rad]."""
    length = np.clip(np.hypot(hip, drop), 0.1, THIGH + SHIN - 1e-3)
    cos = (SHIN**2 + length**2 - THIGH**2) / (2 * SHIN * length)
    return np.arctan2(hip, drop) + np.arccos(np.clip(cos, -1, 1))


def compute_lean(command: np.ndarray) -> np.ndarray:
    """Commanded pitch of the pelvis: what the waist's joint can't take [rad]. (n, 7) -> (n,)."""
    return np.clip(command[:, PITCH] - LEAN_FROM, 0.0, MAX_LEAN)


def compute_velocity(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Velocity in the heading frame: vx, vy [m/s], yaw rate [rad/s]. Shape (n, 3)."""
    yaw = quat_yaw(qpos[:, 3:7])
    cos, sin = np.cos(yaw), np.sin(yaw)
    vx, vy = qvel[:, 0], qvel[:, 1]
    turn = quat_rotate(qpos[:, 3:7], qvel[:, 3:6])[:, 2]
    return np.stack([cos * vx + sin * vy, cos * vy - sin * vx, turn], axis=1)


def _compute_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions. Shape (n, 4) -> (n, 3, 3)."""
    return np.stack([quat_rotate(quat, axis) for axis in np.eye(3)], axis=2)


def _compute_heading_frame(feet: np.ndarray) -> np.ndarray:
    """Rotation from the world to the feet's mean heading. Shape (n, 2, 3, 3) -> (n, 3, 3)."""
    along = feet[..., :2, 0].sum(1)
    cos, sin = (along / np.linalg.norm(along, axis=1, keepdims=True)).T
    frame = np.zeros((len(feet), 3, 3))
    frame[:, 0, 0] = frame[:, 1, 1] = cos
    frame[:, 0, 1], frame[:, 1, 0], frame[:, 2, 2] = sin, -sin, 1.0
    return frame


def _compute_rotation_error(lean: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Rotation vector, for small errors, from `pelvis` to pitch `lean` alone. Shape (n, 3)."""
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
    """Share a wrench about the middle of the feet among the two soles.

    Returns:
        Forces and torques at the middles of the soles. Shapes (n, 2, 3).
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
    """When the balance acts, and when FALCON.

    Attributes:
        hold: Part of the support within which the balance goes on [1].
        take: Part of it within which it takes over [1].
        flat: Largest tilt of a planted foot [rad].
        clear: Largest height of its middle over the ground [m].
        still: Largest speed of a foot that is about to be stood on [m/s].
        spread: Least and largest distance of the feet across [m].
        stagger: And largest along the heading [m].
        sinks: Below this height of the pelvis, and leaning more than `leans`, a robot that is
            to walk stands up first [m].
        stands: From this height on, and leaning less, FALCON walks [m].
        leans: See above [rad].
        blend_s: Time in which the balance takes over [s].
        yield_s: Time in which FALCON does [s].
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
"""Least height that FALCON is told while it stands and while it walks [m]; lower, it loses its
footing."""
RISE = 0.73
"""Height to which a low robot rises before it walks [m]."""
TRIM = np.array([0.06, 0.03, -0.06])
"""What FALCON is told beyond the command while it walks, since it drifts: vx, vy [m/s], yaw
rate [rad/s]."""
FEEDBACK = np.array([1.5, 1.5, 0.7])
"""And for the error of the velocity of now [1]; more of it makes the body's yaw swing."""
MAX_ERROR = 0.5
"""Largest error of a velocity that counts [m/s, rad/s]."""
SUPPORT = 0.08
"""Half of the support's length [m]."""


class Taught(NamedTuple):
    """What the teacher does.

    Attributes:
        targets: Motor targets [rad]. Shape (n, 29).
        actions: Outputs of a network that does the same. Shape (n, 29).
        memory: FALCON's memory after the step. Shape (n, nm).
        share: How much the balance acts, 0 to 1. Shape (n,).
    """

    targets: np.ndarray
    actions: np.ndarray
    memory: np.ndarray
    share: np.ndarray


class Teacher:
    """FALCON and `Balance`.

    The arms' part of the action bears their weight on their soft servos, computed from the model,
    since FALCON does so only in the postures that it was trained with.

    Args:
        path: FALCON's ONNX file; None for the cached or downloaded one.
        gains: Of the balance.
        handover: When it acts.
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
        """FALCON's. Shape (n, nm)."""
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
        """Compute motor targets for the next 20 ms.

        Args:
            true: Generalised positions and velocities. Shapes (n, 36), (n, 35).
            sensed: The same with the sensors' noise, as the student sees them.
            command: Commands. Shape (n, 7).
            arms: Arm targets [rad]. Shape (n, 14).
            memory: FALCON's memory, its last outputs those of whoever drove. Shape (n, nm).
            mode: Mode of each. Shape (n,).
            force: Forces on the hands, world [N]. Shape (n, 2, 3).
            share: How much the balance acted; zero at first. Shape (n,).
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
        where = sensed[0][:, JOINTS.positions][:, ARMS]  # FALCON minds arms that are held up
        _, after = self.falcon.act(*sensed, told, where, memory, mode)
        own = np.zeros((len(qpos), len(JOINTS.names)))
        own[:, LEGS] = balanced.targets
        own[:, WAIST] = command[:, COMMANDED_WAIST]
        own = (np.clip(own, JOINTS.low, JOINTS.high) - self._centre) / ACTION_SCALE
        own[:, WAIST.start + 1 : WAIST.stop] = 0.0  # roll and pitch are moved by the command alone
        actions = after[:, ACTIONS]
        actions += share[:, None] * (own - actions)
        actions[:, ARMS] = (measured.gravity / JOINTS.stiffness)[:, ARMS] / ACTION_SCALE
        targets = self._centre + ACTION_SCALE * actions
        targets[:, WAIST.start + 1 : WAIST.stop] = command[:, COMMANDED_WAIST][:, 1:]
        targets[:, ARMS] += arms
        return Taught(np.clip(targets, JOINTS.low, JOINTS.high), actions.copy(), after, share)

    def _tell(self, command: np.ndarray, walks: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """What FALCON is told in place of the command. Shape (n, 7)."""
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
        """Tell for which robots the balance acts now. Shape (n,)."""
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
