"""The robots' numbers against the published descriptions; skipped where those are absent."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.transforms import quat_exp, quat_from_rpy, quat_multiply, quat_rotate
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.rby1.links import PLACEHOLDER

SHARED = Path(os.environ.get("XOP_SHARED", Path(__file__).parents[3] / "shared"))
G1_XML = SHARED / "reference" / "g1" / "g1_29dof_kinematics.xml"
RBY1_URDF = SHARED / "reference" / "rby1" / "rby1a_v1.2.urdf"
RBY1M_URDF = SHARED / "reference" / "rby1m" / "rby1m_v1.3.urdf"
POSTURES = 20
POSITION_TOLERANCE = 1e-3
"""[m]"""
ANGLE_TOLERANCE = np.radians(0.1)
"""[rad]"""


class LinkNumbers(NamedTuple):
    """Mass [kg], centre of mass [m], inertia matrix about it in the link's axes [kg m^2]."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray


def read_links(model: mujoco.MjModel) -> dict[str, LinkNumbers]:
    links = {}
    for i in range(1, model.nbody):
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[i])
        axes = axes.reshape(3, 3)
        inertia = axes @ np.diag(model.body_inertia[i]) @ axes.T
        links[model.body(i).name] = LinkNumbers(model.body_mass[i], model.body_ipos[i], inertia)
    return links


def check_links(ours: Mapping[str, LinkNumbers], theirs: Mapping[str, LinkNumbers]) -> None:
    assert set(ours) == set(theirs)
    for name, link in theirs.items():
        assert ours[name].mass == pytest.approx(link.mass, rel=1e-5), name
        assert np.allclose(ours[name].com, link.com, atol=1e-6), name
        scale = np.trace(link.inertia)
        assert np.allclose(ours[name].inertia, link.inertia, atol=1e-4 * scale), name


def check_rotation(ours: np.ndarray, theirs: np.ndarray, name: str) -> None:
    """Both are rotation matrices (3, 3) or unit vectors (3,)."""
    if ours.ndim == 1:
        angle = np.arctan2(np.linalg.norm(np.cross(ours, theirs)), ours @ theirs)
    else:
        difference = ours @ theirs.T - np.eye(3)
        angle = np.linalg.norm(difference) / np.sqrt(2)  # small-angle form of the Frobenius norm
    assert angle < ANGLE_TOLERANCE, name


def random_posture(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Angles within the limits, base anywhere. Shape (nq,)."""
    qpos = np.array(model.qpos0)
    qpos[:3] = rng.uniform(-1, 1, 3)
    quat = rng.normal(size=4)
    qpos[3:7] = quat / np.linalg.norm(quat)
    for i in range(1, model.njnt):
        low, high = model.jnt_range[i] if model.jnt_limited[i] else (-np.pi, np.pi)
        qpos[model.jnt_qposadr[i]] = rng.uniform(low, high)
    return qpos


@pytest.fixture(scope="module")
def g1() -> mujoco.MjModel:
    return make_morphology("g1").build_spec("full").compile()


@pytest.fixture(scope="module")
def rby1() -> mujoco.MjModel:
    return make_morphology("rby1").build_spec("full").compile()


@pytest.fixture(scope="module")
def reference() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(G1_XML))


@pytest.mark.skipif(not G1_XML.exists(), reason=f"no reference description at {G1_XML}")
class TestG1:
    def test_joint_frames_at_random_postures(
        self, g1: mujoco.MjModel, reference: mujoco.MjModel
    ) -> None:
        rng = np.random.default_rng(0)
        ours, theirs = mujoco.MjData(g1), mujoco.MjData(reference)
        names = [g1.joint(i).name for i in range(g1.njnt)]
        assert names == [reference.joint(i).name for i in range(reference.njnt)]
        for _ in range(POSTURES):
            ours.qpos[:] = theirs.qpos[:] = random_posture(g1, rng)
            mujoco.mj_kinematics(g1, ours)
            mujoco.mj_kinematics(reference, theirs)
            for i, name in enumerate(names):
                assert np.linalg.norm(ours.xanchor[i] - theirs.xanchor[i]) < 1e-5, name
                body = g1.joint(i).bodyid[0]
                one, two = (d.body(g1.body(body).name).xmat.reshape(3, 3) for d in (ours, theirs))
                check_rotation(one, two, name)
                check_rotation(ours.xaxis[i], theirs.xaxis[i], name)

    def test_limits(self, g1: mujoco.MjModel, reference: mujoco.MjModel) -> None:
        assert np.allclose(g1.jnt_range[1:], reference.jnt_range[1:], atol=1e-6)
        assert g1.jnt_limited[1:].all()
        effort = reference.jnt_actfrcrange[1:]
        for i in range(g1.nu):
            joint = g1.actuator_trnid[i, 0]
            assert np.array_equal(g1.actuator_forcerange[i], effort[joint - 1])

    def test_masses_and_inertias(self, g1: mujoco.MjModel, reference: mujoco.MjModel) -> None:
        theirs = read_links(reference)
        massless = [name for name in theirs if name.startswith("dummy") or "rubber" in name]
        # The description hangs four points of 0.1 g on each foot.
        assert sum(theirs[name].mass for name in massless) == pytest.approx(0.0008)
        check_links(read_links(g1), {n: v for n, v in theirs.items() if n not in massless})
        total = mujoco.mj_getTotalmass(reference)
        assert mujoco.mj_getTotalmass(g1) == pytest.approx(total, rel=1e-3)

    def test_joint_dynamics(self, g1: mujoco.MjModel, reference: mujoco.MjModel) -> None:
        assert np.allclose(g1.dof_damping[6:], reference.dof_damping[6:])
        assert np.allclose(g1.dof_armature[6:], reference.dof_armature[6:])
        assert np.allclose(g1.dof_frictionloss[6:], reference.dof_frictionloss[6:])

    def test_contact_points(self, g1: mujoco.MjModel, reference: mujoco.MjModel) -> None:
        for side in ("left", "right"):
            for i in range(4):
                theirs = reference.site(f"{side}_foot_contact_{i + 1}").pos
                assert np.allclose(g1.site(f"{side}_foot_{i}").pos, theirs)
                assert g1.geom(f"{side}_foot_{i}").size[0] == 0.005


def get_child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    child = element.find(tag)
    assert child is not None, tag
    return child


def get_text(element: ElementTree.Element, key: str) -> str:
    text = element.get(key)
    assert text is not None, key
    return text


class Urdf:
    """A URDF read by hand, so that its numbers pass through none of our code but rotations."""

    def __init__(self, path: Path) -> None:
        root = ElementTree.parse(path).getroot()
        self.links = {get_text(link, "name"): link for link in root.findall("link")}
        self.joints = root.findall("joint")

    @staticmethod
    def vector(element: ElementTree.Element, key: str) -> np.ndarray:
        return np.array([float(x) for x in element.get(key, "0 0 0").split()])

    def numbers(self, name: str) -> LinkNumbers:
        inertial = get_child(self.links[name], "inertial")
        origin, tensor = get_child(inertial, "origin"), get_child(inertial, "inertia")
        keys = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
        inertia = np.array([float(get_text(tensor, key)) for key in keys]).reshape(3, 3)
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, quat_from_rpy(*self.vector(origin, "rpy")))
        axes = axes.reshape(3, 3)
        com, mass = self.vector(origin, "xyz"), get_text(get_child(inertial, "mass"), "value")
        return LinkNumbers(float(mass), com, axes @ inertia @ axes.T)

    def frames(
        self, base: tuple[np.ndarray, np.ndarray], angles: Mapping[str, float]
    ) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Position, quaternion and joint axis in the world, of each link but the base."""
        poses, axes = {"base": base}, {}
        for joint in self.joints:  # a parent comes before its children in this file, or is retried
            poses, axes = self._place(joint, poses, axes, angles)
        while len(poses) < len(self.links):
            for joint in self.joints:
                poses, axes = self._place(joint, poses, axes, angles)
        return {name: (poses[name][0], poses[name][1], axis) for name, axis in axes.items()}

    def _place(self, joint, poses: dict, axes: dict, angles: Mapping[str, float]) -> tuple:
        parent, child = joint.find("parent").get("link"), joint.find("child").get("link")
        if parent not in poses or child in poses:
            return poses, axes
        pos, quat = poses[parent]
        origin = joint.find("origin")
        pos = pos + quat_rotate(quat, self.vector(origin, "xyz"))
        quat = quat_multiply(quat, quat_from_rpy(*self.vector(origin, "rpy")))
        axis, angle = self.vector(joint.find("axis"), "xyz"), angles.get(joint.get("name"), 0.0)
        world_axis = quat_rotate(quat, axis)
        if joint.get("type") == "prismatic":
            pos = pos + angle * world_axis
        else:
            quat = quat_multiply(quat, quat_exp(angle * axis))
        poses[child], axes[child] = (pos, quat), world_axis
        return poses, axes


def check_frames(model: mujoco.MjModel, urdf: Urdf) -> None:
    """Every link is where the description has it, at random postures."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    matrix = np.zeros(9)
    for _ in range(POSTURES):
        data.qpos[:] = random_posture(model, rng)
        mujoco.mj_kinematics(model, data)
        angles = {
            model.joint(i).name: data.qpos[model.jnt_qposadr[i]] for i in range(1, model.njnt)
        }
        frames = urdf.frames((data.qpos[:3].copy(), data.qpos[3:7].copy()), angles)
        assert len(frames) == model.nbody - 2
        for link, (pos, quat, axis) in frames.items():
            body = model.body(link)
            assert np.linalg.norm(data.body(link).xpos - pos) < POSITION_TOLERANCE, link
            mujoco.mju_quat2Mat(matrix, quat)
            check_rotation(data.body(link).xmat.reshape(3, 3), matrix.reshape(3, 3), link)
            if body.jntnum[0]:
                check_rotation(data.xaxis[body.jntadr[0]], axis / np.linalg.norm(axis), link)


@pytest.fixture(scope="module")
def urdf() -> Urdf:
    return Urdf(RBY1_URDF)


@pytest.mark.skipif(not RBY1_URDF.exists(), reason=f"no reference description at {RBY1_URDF}")
class TestRby1:
    def test_joint_frames_at_random_postures(self, rby1: mujoco.MjModel, urdf: Urdf) -> None:
        check_frames(rby1, urdf)

    def test_limits(self, rby1: mujoco.MjModel, urdf: Urdf) -> None:
        efforts = {
            rby1.joint(int(rby1.actuator_trnid[i, 0])).name: rby1.actuator_forcerange[i, 1]
            for i in range(rby1.nu)
        }
        moving = [joint for joint in urdf.joints if joint.get("type") != "fixed"]
        assert len(moving) == rby1.njnt - 1
        for joint in moving:
            name, limit = get_text(joint, "name"), get_child(joint, "limit")
            ours = rby1.joint(name)
            if joint.get("type") == "continuous":
                assert not rby1.jnt_limited[ours.id]
                speed = rby1.actuator(name).ctrlrange[1]
                assert speed == pytest.approx(float(get_text(limit, "velocity")))
                continue
            theirs = [float(get_text(limit, key)) for key in ("lower", "upper")]
            assert np.allclose(ours.range, theirs, atol=1e-6), name
            if name in efforts:
                assert efforts[name] == float(get_text(limit, "effort")), name
                if name.startswith(("torso", "left_arm", "right_arm")):
                    assert efforts[name] < PLACEHOLDER

    def test_masses_and_inertias(self, rby1: mujoco.MjModel, urdf: Urdf) -> None:
        check_links(read_links(rby1), {name: urdf.numbers(name) for name in urdf.links})
        total = sum(urdf.numbers(name).mass for name in urdf.links)
        assert mujoco.mj_getTotalmass(rby1) == pytest.approx(total, rel=1e-6)
        assert total == pytest.approx(132.2, abs=0.05)

    def test_drive_matches_the_description(self, rby1: mujoco.MjModel) -> None:
        mobile = get_child(ElementTree.parse(RBY1_URDF).getroot(), "mobile")
        track, radius = (float(x) for x in get_text(mobile, "params").split())
        data = mujoco.MjData(rby1)
        mujoco.mj_kinematics(rby1, data)
        wheels = [data.site(f"{side}_wheel_center").xpos for side in ("left", "right")]
        assert wheels[0][1] - wheels[1][1] == pytest.approx(track)
        assert rby1.geom("left_wheel").size[0] == pytest.approx(radius)
        assert wheels[0][2] == pytest.approx(radius)
        middle = float(get_text(mobile, "xyz").split()[0])
        assert np.mean(wheels, axis=0)[0] == pytest.approx(middle)


@pytest.fixture(scope="module")
def rby1m() -> mujoco.MjModel:
    return make_morphology("rby1m").build_spec("full").compile()


@pytest.fixture(scope="module")
def urdf_m() -> Urdf:
    return Urdf(RBY1M_URDF)


@pytest.mark.skipif(not RBY1M_URDF.exists(), reason=f"no reference description at {RBY1M_URDF}")
class TestRby1M:
    """Wheels turn in no joint of our model; all else is compared."""

    def test_joint_frames_at_random_postures(self, rby1m: mujoco.MjModel, urdf_m: Urdf) -> None:
        check_frames(rby1m, urdf_m)

    def test_limits(self, rby1m: mujoco.MjModel, urdf_m: Urdf) -> None:
        efforts = {
            rby1m.joint(int(rby1m.actuator_trnid[i, 0])).name: rby1m.actuator_forcerange[i, 1]
            for i in range(rby1m.nu)
            if rby1m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        }
        moving = [
            joint for joint in urdf_m.joints if joint.get("type") not in ("fixed", "continuous")
        ]
        assert len(moving) == rby1m.njnt - 1
        for joint in moving:
            name, limit = get_text(joint, "name"), get_child(joint, "limit")
            theirs = [float(get_text(limit, key)) for key in ("lower", "upper")]
            assert np.allclose(rby1m.joint(name).range, theirs, atol=1e-6), name
            if name in efforts:
                assert efforts[name] == float(get_text(limit, "effort")), name
        torso = {f"torso_{i}" for i in range(6)}
        arms = {f"{side}_arm_{i}" for side in ("left", "right") for i in range(7)}
        assert torso | arms <= set(efforts)

    def test_masses_and_inertias(self, rby1m: mujoco.MjModel, urdf_m: Urdf) -> None:
        check_links(read_links(rby1m), {name: urdf_m.numbers(name) for name in urdf_m.links})
        total = sum(urdf_m.numbers(name).mass for name in urdf_m.links)
        assert mujoco.mj_getTotalmass(rby1m) == pytest.approx(total, rel=1e-6)
        assert total == pytest.approx(163.8, abs=0.05)

    def test_drive_matches_the_description(self, rby1m: mujoco.MjModel) -> None:
        mobile = get_child(ElementTree.parse(RBY1M_URDF).getroot(), "mobile")
        assert get_text(mobile, "type") == "mecanum"
        length, width, radius = (float(x) for x in get_text(mobile, "params").split())
        data = mujoco.MjData(rby1m)
        mujoco.mj_kinematics(rby1m, data)
        wheels = get_text(mobile, "joints").split()
        drive = make_morphology("rby1m").drive
        assert drive is not None
        assert set(drive.wheels) == set(wheels)
        for name in wheels:
            place = data.site(name).xpos  # where it touches the ground
            assert abs(place[0] + 0.002) == pytest.approx(length)
            assert abs(place[1]) == pytest.approx(width)
            assert place[2] == pytest.approx(0, abs=1e-9)
            assert abs(drive.wheels[name][2]) == pytest.approx(length + width)
        assert drive.radius == radius == rby1m.geom("front_left_wheel").size[0]
