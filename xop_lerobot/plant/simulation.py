"""Simulated plant: MuJoCo, by default at 200 Hz."""

from __future__ import annotations

import logging
import math
import threading
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from xop_lerobot.core.command import check_vector
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose
from xop_lerobot.plant.config import SimulationConfig, compute_num_steps
from xop_lerobot.plant.contacts import ContactTable
from xop_lerobot.plant.objects import SceneObjects
from xop_lerobot.plant.plant import Measurement, Plant
from xop_lerobot.plant.rendering import Cameras
from xop_lerobot.plant.sensors import Sensors

if TYPE_CHECKING:
    from xop_lerobot.low_level.policy import LowLevelPolicy
    from xop_lerobot.morphology.morphology import ModelKind, Morphology
    from xop_lerobot.plant.viewer import Viewer

logger = logging.getLogger(__name__)

_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class Simulation(Plant):
    """A simulated robot in a scene.

    The robot comes first in the model; the published `qpos` and `qvel` are its own. The scene's
    objects are accessible by `object_names` and `get_object_pose`.

    `step` advances by whole physics steps with the targets of the last `apply`. After it, body and
    site positions in `data` are those of the new `qpos`. If the physics diverges, the robot
    freezes in its last valid state and counts as fallen until `reset`.

    `step`, `measure` and `render` may be called from different threads.

    Args:
        morphology: The robot.
        config: Scene, noise, seed, images.
        kind: Model to simulate; tests use the planning model for comparisons.
        model: A compiled model with the robot first, instead of the robot in the named scene.
        standing: Configuration after `reset`; by default the standing posture. Shape (nq,).

    Raises:
        UnknownName: If there is no such scene.
        BadValue: If the physics step does not divide 20 ms, or a sensor's rate or delay is not a
            whole number of physics steps.
    """

    def __init__(
        self,
        morphology: Morphology,
        config: SimulationConfig | None = None,
        *,
        kind: ModelKind = "full",
        model: mujoco.MjModel | None = None,
        standing: np.ndarray | None = None,
    ) -> None:
        self.morphology = morphology
        self.config = config or SimulationConfig()
        if model is None:
            from xop_lerobot.morphology.scene import build_model  # noqa: PLC0415 builds robots

            model = build_model(morphology, kind, scene=self.config.scene)
        _log_mujoco_warnings()
        self.model = model
        model.opt.timestep = self.config.time_step
        # Autoreset would silently restart a diverged simulation.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(model)
        self._base = model.body(morphology.base_body).id
        self._contacts = ContactTable(model, morphology)
        self._objects = SceneObjects(model, self._contacts.robot_bodies)
        self.nq, self.nv = _compute_robot_size(model, self._contacts.robot_bodies)
        standing = morphology.standing_qpos() if standing is None else standing
        self._standing = check_vector("standing_qpos", standing, self.nq)
        self._sensors = Sensors(
            model, self.nq, self.nv, self.config.resolved_noise, self.config.time_step
        )
        self.cameras = Cameras(model, self.config.width, self.config.height)
        self._lock = threading.RLock()
        self._viewer: Viewer | None = None
        self._num_resets = 0
        self._num_steps = 0
        self._has_fallen = self._diverged = False
        self._collisions: set[tuple[str, str]] = set()
        self._touches: set[tuple[str, str]] = set()
        self.reset()
        if self.config.viewer:
            from xop_lerobot.plant.viewer import start_viewer  # noqa: PLC0415 loads a web server

            self._viewer = start_viewer(model, self.data, self.config.viewer_port)

    # -- interface of a plant --------------------------------------------------------------

    def reset(self, seed: int | None = None) -> None:
        """Put the robot at rest in its standing posture, and all objects at their start poses.

        Args:
            seed: Seed of the noise; the same seed gives the same run. None takes the next one of
                the configured seed's sequence, so that the episodes of a session differ.
        """
        # The second number keeps given seeds apart from those of the session's sequence.
        entropy = (self.config.seed, 0, self._num_resets) if seed is None else (seed, 1)
        with self._lock:
            if seed is None:
                self._num_resets += 1
            mujoco.mj_resetData(self.model, self.data)
            self.data.qpos[: self.nq] = self._standing
            self.data.ctrl[:] = self._compute_holding_targets()
            self._ramp_to: np.ndarray | None = None
            mujoco.mj_forward(self.model, self.data)
            self._num_steps = 0
            self._has_fallen = self._diverged = False
            self._collisions = self._contacts.find_collisions(self.data)
            self._touches = set()
            self._sensors.reset(np.random.SeedSequence(entropy), *self._get_true_state())

    def measure(self) -> Measurement:
        """Read the sensors, without side effects; all arrays are new."""
        with self._lock:
            true_qpos, true_qvel = self._get_true_state()
            qpos, qvel = self._sensors.read(true_qpos, true_qvel)
            return Measurement(
                time=self.time,
                qpos=qpos,
                qvel=qvel,
                effort=self.data.actuator_force.copy(),
                true_qpos=true_qpos.copy(),
                true_qvel=true_qvel.copy(),
                fallen=self._has_fallen,
                collision=bool(self._collisions),
                contacts=tuple(sorted(self._collisions)),
            )

    def apply(self, targets: np.ndarray) -> None:
        """Set the target of every actuator; the model limits controls and torques.

        Raises:
            BadShape: If there are not `nu` targets.
            BadValue: If one is not finite.
        """
        targets = check_vector("targets", targets, self.model.nu)
        with self._lock:
            self.data.ctrl[:] = targets
            self._ramp_to = None

    def ramp(self, targets: np.ndarray) -> None:
        """Interpolate linearly to the targets over the physics steps of the next `step`.

        Raises:
            BadShape: If there are not `nu` targets.
            BadValue: If one is not finite.
        """
        targets = check_vector("targets", targets, self.model.nu)
        with self._lock:
            self._ramp_to = targets

    def adapt(self, policy: LowLevelPolicy) -> None:
        """Set the motors to those that `policy` was trained with."""
        with self._lock:
            policy.adapt(self.model)

    def step(self, dt: float) -> None:
        """Simulate `dt` [s].

        Raises:
            BadValue: If `dt` is not a whole number of physics steps; names both.
        """
        num_steps = compute_num_steps(dt, self.config.time_step)
        with self._lock:
            if num_steps:
                self._collisions = set()
            begin, end = self.data.ctrl.copy(), self._ramp_to
            for i in range(num_steps):
                if end is not None:
                    self.data.ctrl[:] = begin + (i + 1) / num_steps * (end - begin)
                self._step_once()
            if num_steps:
                self._ramp_to = None
            self._touches |= self._collisions
            if num_steps:
                self._update_positions()
            if self._viewer is not None:
                self._viewer.update(self.data)

    def render(self, camera: str) -> np.ndarray:
        """Image of `camera`. Shape (height, width, 3), uint8.

        Raises:
            UnknownName: Listing the cameras.
            RenderingUnavailable: If this machine has no OpenGL.
        """
        return self.cameras.render(camera, self.data, self._lock)

    def close(self) -> None:
        """Close viewer and renderer; may be called twice."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
        self.cameras.close()

    # -- specific to a simulation ----------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time since reset, without accumulated rounding [s]."""
        return self._num_steps * self.config.time_step

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of the model's cameras."""
        return self.cameras.names

    @property
    def fallen(self) -> bool:
        """Whether the robot is fallen now."""
        height, cos_tilt = self.data.xpos[self._base, 2], self.data.xmat[self._base, 8]
        return bool(
            self._diverged
            or height < self.morphology.fall_height
            or cos_tilt < math.cos(self.morphology.fall_tilt)
        )

    @property
    def has_fallen(self) -> bool:
        """Whether the robot has fallen at any time since reset."""
        return self._has_fallen

    @property
    def diverged(self) -> bool:
        """Whether the physics has diverged since reset."""
        return self._diverged

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray | None = None) -> None:
        """Set the robot's state; sensors measure it at once. Shapes (nq,), (nv,)."""
        qpos = check_vector("qpos", qpos, self.nq)
        qvel = np.zeros(self.nv) if qvel is None else check_vector("qvel", qvel, self.nv)
        with self._lock:
            self.data.qpos[: self.nq] = qpos
            self.data.qvel[: self.nv] = qvel
            mujoco.mj_normalizeQuat(self.model, self.data.qpos)
            mujoco.mj_forward(self.model, self.data)
            self._has_fallen |= self.fallen
            self._collisions = self._contacts.find_collisions(self.data)
            self._sensors.hold(*self._get_true_state())

    @property
    def lock(self) -> threading.RLock:
        """Lock of the physics; hold it to read `data` consistently from another thread."""
        return self._lock

    def take_touches(self) -> set[tuple[str, str]]:
        """Return all collisions since the last call or `reset`, as in `Measurement.contacts`."""
        with self._lock:
            touches, self._touches = self._touches, set()
        return touches

    def rearrange(self) -> None:
        """Update derived quantities after furniture or objects were moved directly."""
        with self._lock:
            mujoco.mj_forward(self.model, self.data)
            self._collisions = self._contacts.find_collisions(self.data)
            self._touches = set()

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the scene's movable bodies."""
        return self._objects.names

    def get_object_pose(self, name: str) -> np.ndarray:
        """Pose of an object, x y z qw qx qy qz. Shape (7,).

        Raises:
            UnknownName: Listing the objects.
        """
        return self._objects.get_pose(self.data, name)

    def set_object_pose(self, name: str, pose: np.ndarray) -> None:
        """Place an object at rest at `pose`, x y z qw qx qy qz. Shape (7,).

        Raises:
            UnknownName: Listing the objects.
        """
        pose = check_vector("pose", pose, 7)
        with self._lock:
            self._objects.set_pose(self.data, name, pose)
            mujoco.mj_forward(self.model, self.data)
            self._collisions = self._contacts.find_collisions(self.data)

    def get_site_pose(self, name: str) -> np.ndarray:
        """True pose of a site in the world, x y z qw qx qy qz. Shape (7,).

        Raises:
            UnknownName: Listing the sites.
        """
        index = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name)
        if index < 0:
            known = (self.model.site(i).name for i in range(self.model.nsite))
            raise UnknownName("site", name, known)
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self.data.site_xmat[index])
        return make_pose(self.data.site_xpos[index], quat)

    # -- internals -------------------------------------------------------------------------

    def _get_true_state(self) -> tuple[np.ndarray, np.ndarray]:
        return self.data.qpos[: self.nq], self.data.qvel[: self.nv]

    def _step_once(self) -> None:
        """Advance by one physics step; after divergence only the time advances."""
        data = self.data
        self._num_steps += 1
        if not self._diverged:
            sound_qpos, sound_qvel = data.qpos.copy(), data.qvel.copy()
            mujoco.mj_step(self.model, data)
            self._collisions |= self._contacts.find_collisions(data)
            if self._has_run_away():
                self._freeze(sound_qpos, sound_qvel)
            else:
                self._has_fallen |= self.fallen
        if not self._sensors.is_exact:
            self._sensors.observe(self._num_steps, *self._get_true_state())

    def _has_run_away(self) -> bool:
        """Whether MuJoCo has warned of a number that is not finite or beyond 1e10."""
        warning = self.data.warning
        return any(warning[kind].number for kind in _DIVERGED)

    def _freeze(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Keep the last valid position, at rest, and count the robot as fallen."""
        fastest = int(np.argmax(np.abs(qvel)))
        joint = self.model.joint(int(self.model.dof_jntid[fastest])).name
        logger.error(
            "the simulation of '%s' diverged at %.3f s (fastest joint before: '%s' at %.3g); "
            "the robot is frozen and counts as fallen until reset",
            self.morphology.name,
            self.time,
            joint,
            qvel[fastest],
        )
        self.data.qpos[:], self.data.qvel[:] = qpos, 0
        self.data.actuator_force[:] = 0
        self._diverged = self._has_fallen = True

    def _update_positions(self) -> None:
        """Update positions of bodies, sites, cameras and lights to `qpos`.

        `mj_step` leaves them at the configuration before its integration.
        """
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._has_fallen |= self.fallen

    def _compute_holding_targets(self) -> np.ndarray:
        r"""Controls with which position actuators hold the posture; 0 for others. Shape (nu,).

        Position actuators are those with the force :math:`k_p (u - q) - k_d \dot q`: the bias on q
        is the negative gain.
        """
        model = self.model
        targets = np.zeros(model.nu)
        for i in range(model.nu):
            is_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
            gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i, 1]
            if is_joint and gain > 0 and np.isclose(bias, -gain):
                joint = model.actuator_trnid[i, 0]
                targets[i] = self.data.qpos[model.jnt_qposadr[joint]]
        return targets


def _compute_robot_size(model: mujoco.MjModel, robot_bodies: np.ndarray) -> tuple[int, int]:
    """Sizes of the robot's position and velocity.

    Raises:
        BadValue: If the robot's joints do not come first in the model.
    """
    joints = np.flatnonzero(np.isin(model.jnt_bodyid, robot_bodies))
    if not np.array_equal(joints, np.arange(joints.size)):
        raise BadValue("the robot's joints must be the first of the model, before the scene's")
    after = joints.size
    nq = int(model.jnt_qposadr[after]) if after < model.njnt else model.nq
    nv = int(model.jnt_dofadr[after]) if after < model.njnt else model.nv
    return nq, nv


def _log_mujoco_warnings() -> None:
    """Send MuJoCo's warnings to the log; by default it writes a file to the working directory.

    At debug level, since a planner's samples may diverge by design; the plant reports its own
    divergence.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda text: logger.debug("MuJoCo: %s", text))
