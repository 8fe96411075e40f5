"""Tables of links, shapes and frames, and functions that build MuJoCo models from them.

The rows are plain data that import quickly; only the `add_*` functions load MuJoCo.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from xop_lerobot.core.transforms import quat_from_matrix, quat_from_rpy

if TYPE_CHECKING:
    import mujoco

Vector = tuple[float, ...]

FLOOR_BIT, ROBOT_BIT, OBJECT_BIT = 1, 2, 4
"""Collision bits: what a geom is (`contype`) and what it collides with (`conaffinity`)."""


@dataclass(frozen=True)
class Joint:
    """A joint with one degree of freedom.

    Attributes:
        name: Its name.
        axis: Axis in the child link's frame.
        limits: Lower and upper limit [rad or m]; None for a continuous joint.
        effort: Largest torque or force [N m or N].
        velocity: Largest velocity [rad/s or m/s].
        slides: Whether it slides rather than turns.
    """

    name: str
    axis: Vector
    limits: tuple[float, float] | None
    effort: float
    velocity: float
    slides: bool = False


@dataclass(frozen=True)
class Link:
    """A rigid body and the joint that holds it to its parent.

    Attributes:
        name: Its name.
        parent: Name of the parent link, None for the floating base.
        pos: Origin in the parent's frame [m].
        mass: Mass [kg].
        com: Centre of mass in the link's frame [m].
        inertia: About the centre of mass [kg m^2]: three principal moments in the axes of
            `inertia_quat`, or xx, yy, zz, xy, xz, yz in the link's axes.
        joint: The joint, None for a link that is fixed to its parent or floats.
        quat: Orientation in the parent's frame at joint angle 0, wxyz.
        inertia_quat: Orientation of the principal axes, wxyz.
    """

    name: str
    parent: str | None
    pos: Vector
    mass: float
    com: Vector
    inertia: Vector
    joint: Joint | None = None
    quat: Vector = (1, 0, 0, 0)
    inertia_quat: Vector = (1, 0, 0, 0)


@dataclass(frozen=True)
class Shape:
    """A primitive for collision, display, or both.

    Attributes:
        link: The link it is fixed to.
        kind: ``"box"``, ``"sphere"``, ``"ellipsoid"``, ``"cylinder"`` or ``"capsule"``.
        size: Half sizes, or radius and half length, as in MuJoCo [m].
        pos: Centre in the link's frame [m].
        rpy: Roll, pitch, yaw in the link's frame [rad].
        ends: End points of the axis of a capsule or cylinder, instead of `pos` and `rpy` [m].
        material: Name of its material; None for an invisible shape.
        collides: Whether it collides with the floor, with objects and with other links.
        name: Name of the geom; empty for none.
    """

    link: str
    kind: str
    size: Vector
    pos: Vector = (0, 0, 0)
    rpy: Vector = (0, 0, 0)
    ends: Vector | None = None
    material: str | None = None
    collides: bool = True
    name: str = ""


def mirror(shape: Shape) -> Shape:
    """Return the right-hand counterpart of a left-hand shape (y to -y)."""
    x, y, z = shape.pos
    roll, pitch, yaw = shape.rpy
    ends = shape.ends
    return replace(
        shape,
        link=shape.link.replace("left", "right"),
        name=shape.name.replace("left", "right"),
        pos=(x, -y, z),
        rpy=(-roll, pitch, -yaw),
        ends=ends and (ends[0], -ends[1], ends[2], ends[3], -ends[4], ends[5]),
    )


def look(link: str, kind: str, size: tuple[float, ...], material: str, **where: Any) -> Shape:
    """Return a visible shape without collisions."""
    return Shape(link, kind, size, material=material, collides=False, **where)


@dataclass(frozen=True)
class Frame:
    """A named frame on a link: a site or a camera.

    Attributes:
        name: Its name.
        link: The link it is fixed to.
        pos: Origin in the link's frame [m].
        x_axis: Its X axis in the link's frame.
        z_axis: Its Z axis in the link's frame; Y = Z × X.
    """

    name: str
    link: str
    pos: Vector
    x_axis: Vector = (1, 0, 0)
    z_axis: Vector = (0, 0, 1)

    @property
    def quat(self) -> np.ndarray:
        """Orientation in the link's frame, wxyz. Shape (4,)."""
        x_axis = np.asarray(self.x_axis, float)
        x_axis = x_axis / np.linalg.norm(x_axis)
        z_axis = np.asarray(self.z_axis, float)
        z_axis = z_axis - (z_axis @ x_axis) * x_axis
        z_axis = z_axis / np.linalg.norm(z_axis)
        return quat_from_matrix(np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1))


def new_spec(name: str, timestep: float) -> mujoco.MjSpec:
    """Make an empty model with the settings that all robots share.

    Args:
        name: Name of the model.
        timestep: Physics step [s].
    """
    import mujoco  # noqa: PLC0415

    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # Constraint islands pay off for many separate bodies; a single robot is faster without them.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    return spec


def add_links(spec: mujoco.MjSpec, links: Iterable[Link], free_joint: str) -> None:
    """Add bodies, inertias and joints; the first link floats on `free_joint`."""
    import mujoco  # noqa: PLC0415

    for link in links:
        parent = spec.worldbody if link.parent is None else spec.body(link.parent)
        body = parent.add_body(name=link.name, pos=link.pos, quat=link.quat)
        body.explicitinertial = True
        body.mass, body.ipos = link.mass, link.com
        if len(link.inertia) == 6:
            body.fullinertia = link.inertia
        else:
            body.inertia, body.iquat = link.inertia, link.inertia_quat
        if link.parent is None:
            body.add_freejoint(name=free_joint)
        elif link.joint is not None:
            joint = link.joint
            kind = mujoco.mjtJoint.mjJNT_SLIDE if joint.slides else mujoco.mjtJoint.mjJNT_HINGE
            made = body.add_joint(name=joint.name, type=kind, axis=joint.axis)
            if joint.limits is not None:
                made.limited, made.range = True, joint.limits


def add_materials(spec: mujoco.MjSpec, colours: Mapping[str, Vector]) -> None:
    """Add matte materials: name to red, green, blue and gloss, each 0 to 1."""
    for name, (red, green, blue, gloss) in colours.items():
        spec.add_material(
            name=name, rgba=(red, green, blue, 1), specular=gloss, shininess=0.4, reflectance=0
        )


def add_shapes(spec: mujoco.MjSpec, shapes: Iterable[Shape]) -> None:
    """Add geoms: visible ones in group 2, invisible collision geoms in group 3; none adds mass."""
    import mujoco  # noqa: PLC0415

    for shape in shapes:
        geom = spec.body(shape.link).add_geom(
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}"),
            size=[*shape.size, 0, 0][:3],
            mass=0,
            group=3 if shape.material is None else 2,
        )
        if shape.name:
            geom.name = shape.name
        if shape.ends is not None:
            geom.fromto = shape.ends
        else:
            geom.pos, geom.quat = shape.pos, quat_from_rpy(*shape.rpy)
        if shape.material is not None:
            geom.material = shape.material
        if shape.collides:
            geom.contype, geom.conaffinity = ROBOT_BIT, FLOOR_BIT | ROBOT_BIT | OBJECT_BIT
        else:
            geom.contype = geom.conaffinity = 0


def add_sites(spec: mujoco.MjSpec, frames: Iterable[Frame]) -> None:
    """Add a site for each frame."""
    for frame in frames:
        spec.body(frame.link).add_site(
            name=frame.name, pos=frame.pos, quat=frame.quat, size=(0.005,) * 3, group=5
        )


def add_camera(spec: mujoco.MjSpec, frame: Frame, fovy: float, *, tracking: bool = False) -> None:
    """Add a camera that looks along the X axis of `frame`, whose Z axis is up in the image.

    Args:
        spec: The model.
        frame: Pose of the camera.
        fovy: Vertical field of view [deg].
        tracking: Whether it follows only the link's position and keeps its direction.
    """
    import mujoco  # noqa: PLC0415

    x_axis, z_axis = np.asarray(frame.x_axis, float), np.asarray(frame.z_axis, float)
    # MuJoCo's cameras look along -Z with Y up.
    seen = Frame(frame.name, frame.link, frame.pos, tuple(np.cross(x_axis, z_axis)), tuple(-x_axis))
    mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACK if tracking else mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    spec.body(frame.link).add_camera(
        name=frame.name, pos=frame.pos, quat=seen.quat, fovy=fovy, mode=mode
    )


def add_servo(
    spec: mujoco.MjSpec,
    joint: Joint,
    stiffness: float,
    damping: float,
    *,
    name: str = "",
    force: float | None = None,
) -> None:
    r"""Add a position servo :math:`\tau = k_p (u - q) - k_d \dot q`, :math:`|\tau| \le f`.

    Args:
        spec: The model.
        joint: The joint it drives, whose limits also limit the control.
        stiffness: k_p [N m/rad or N/m].
        damping: k_d [N m s/rad or N s/m].
        name: Name of the actuator, the joint's by default.
        force: Limit f, the joint's effort by default.
    """
    import mujoco  # noqa: PLC0415

    force = joint.effort if force is None else force
    actuator = spec.add_actuator(
        name=name or joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
    )
    actuator.set_to_position(kp=stiffness, kv=damping)
    actuator.forcelimited, actuator.forcerange = True, (-force, force)
    if joint.limits is not None:
        actuator.ctrllimited, actuator.ctrlrange = True, joint.limits


def add_imu(spec: mujoco.MjSpec) -> None:
    """Add the inertial sensors at the site `imu`."""
    import mujoco  # noqa: PLC0415

    for name, kind in (
        ("imu_quat", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ("imu_gyro", mujoco.mjtSensor.mjSENS_GYRO),
        ("imu_acc", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
