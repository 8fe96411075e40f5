"""Batched kinematics against MuJoCo's own, on both robots and on a model with every joint."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.transforms import make_pose, quat_exp
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.model.kinematics import SiteKinematics

MIXED = """
<mujoco>
  <worldbody>
    <site name="ground" pos="0 0 0"/>
    <body name="pillar" pos="1 2 0.5" euler="0 0 30">
      <geom size="0.1" mass="3"/>
      <body name="slider" pos="0 0 0.4" euler="20 0 0">
        <joint name="slide" type="slide" axis="1 2 2"/>
        <geom size="0.1" mass="1" pos="0.1 0 0"/>
        <body name="rigid" pos="0.1 0 0.1" euler="0 40 0">
          <geom size="0.05" mass="0.7"/>
          <body name="arm" pos="0 0.2 0">
            <joint name="hinge" axis="0.3 -1 0.5"/>
            <geom type="box" size="0.1 0.02 0.03" mass="0.4" pos="0.1 0 0"/>
            <site name="tip" pos="0.2 0 0.05" euler="10 20 30"/>
          </body>
        </body>
      </body>
    </body>
    <body name="drone" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.05" mass="2" pos="0 0.1 0"/>
      <site name="camera" pos="0.1 0 -0.1" euler="0 90 0"/>
      <body name="rotor" pos="0 0 0.1">
        <joint name="rotor" axis="0 0 1"/>
        <geom size="0.03" mass="0.1" pos="0.05 0 0"/>
        <site name="blade" pos="0.3 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def build(inner: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{inner}</worldbody></mujoco>")


def draw_qpos(model: mujoco.MjModel, rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Any configuration: hinges over their range or a turn, free joints anywhere."""
    qpos = np.empty((*shape, model.nq))
    for joint in range(model.njnt):
        address = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            qpos[..., address : address + 3] = rng.normal(size=(*shape, 3))
            qpos[..., address + 3 : address + 7] = quat_exp(rng.normal(size=(*shape, 3)))
        else:
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-3.0, 3.0)
            qpos[..., address] = rng.uniform(low, high, shape)
    return qpos


def compute_with_mujoco(
    model: mujoco.MjModel, qpos: np.ndarray, sites: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """The slow way: one configuration at a time."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    poses = {}
    for name in sites:
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, data.site(name).xmat)
        poses[name] = make_pose(data.site(name).xpos, quat * (1 if quat[0] >= 0 else -1))
    return poses


def assert_equal_to_mujoco(model: mujoco.MjModel, sites: tuple[str, ...], seed: int = 0) -> None:
    qpos = draw_qpos(model, np.random.default_rng(seed), 4, 3)
    poses = SiteKinematics(model, sites).compute_poses(qpos)
    assert set(poses) == set(sites)
    for index in np.ndindex(4, 3):
        expected = compute_with_mujoco(model, qpos[index], sites)
        for name in sites:
            got = poses[name][index]
            np.testing.assert_allclose(got[:3], expected[name][:3], atol=1e-12)
            # A half turn has two quaternions with w near 0.
            assert abs(got[3:] @ expected[name][3:]) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("name", ["g1", "rby1"])
def test_robots_equal_mujoco(name):
    morphology = make_morphology(name)
    model = build_model(morphology, "planning")
    assert_equal_to_mujoco(model, (*morphology.frames.values(), *morphology.contact_points))


def test_slide_hinge_free_and_fixed_bodies_equal_mujoco():
    model = mujoco.MjModel.from_xml_string(MIXED)
    assert_equal_to_mujoco(model, ("tip", "camera", "blade"), seed=1)
    assert_equal_to_mujoco(model, ("tip",), seed=2)


def test_a_site_alone_equals_the_same_site_among_others():
    model = mujoco.MjModel.from_xml_string(MIXED)
    qpos = draw_qpos(model, np.random.default_rng(3), 5)
    alone, all_of_them = (
        SiteKinematics(model, sites).compute_poses(qpos)["blade"]
        for sites in (("blade",), ("tip", "camera", "blade"))
    )
    np.testing.assert_array_equal(alone, all_of_them)


def test_a_single_configuration_needs_no_batch():
    model = mujoco.MjModel.from_xml_string(MIXED)
    assert SiteKinematics(model, ("tip",)).compute_poses(model.qpos0)["tip"].shape == (7,)


def test_an_unknown_site_lists_the_known_ones():
    with pytest.raises(UnknownName) as caught:
        SiteKinematics(mujoco.MjModel.from_xml_string(MIXED), ("nose",))
    assert str(caught.value) == "unknown site 'nose'. Known: blade, camera, ground, tip"


@pytest.mark.parametrize(
    "joints, text",
    [
        ('<joint name="j" type="ball"/>', "joint 'j' must be free, hinge or slide"),
        (
            '<joint name="j" axis="0 0 1" pos="0.1 0 0"/>',
            "joint 'j' must sit at its body's origin",
        ),
        (
            '<joint name="j" axis="0 0 1"/><joint name="k" axis="1 0 0"/>',
            "body 'b' has 2 joints, expected at most 1",
        ),
    ],
)
def test_joints_it_cannot_handle_are_refused(joints, text):
    model = build(f'<body name="b">{joints}<geom size="0.1"/><site name="s"/></body>')
    with pytest.raises(BadValue) as caught:
        SiteKinematics(model, ("s",))
    assert str(caught.value) == text


def test_what_is_not_on_the_way_is_not_refused():
    model = build(
        '<body name="a"><joint axis="0 0 1"/><geom size="0.1"/><site name="s" pos="1 0 0"/></body>'
        '<body name="b"><joint type="ball"/><geom size="0.1"/></body>'
    )
    quarter = np.array([np.pi / 2, 1, 0, 0, 0])
    pose = SiteKinematics(model, ("s",)).compute_poses(quarter)["s"]
    np.testing.assert_allclose(pose[:3], [0, 1, 0], atol=1e-12)


def test_a_robot_whose_sites_are_all_on_its_base():
    model = build(
        '<body name="b"><freejoint/><geom size="0.1"/><site name="s" pos="1 0 0"/></body>'
    )
    assert_equal_to_mujoco(model, ("s",))


def test_a_joint_with_a_reference_angle():
    model = build(
        '<body name="b"><joint axis="0 0 1" ref="30"/><geom size="0.1"/>'
        '<body name="c"><joint type="slide" axis="0 1 1" ref="0.4"/><geom size="0.1"/>'
        '<site name="s" pos="1 0 0"/></body></body>'
    )
    assert_equal_to_mujoco(model, ("s",))


def test_a_site_on_the_world_stays():
    model = mujoco.MjModel.from_xml_string(MIXED)
    assert_equal_to_mujoco(model, ("ground",))
    assert_equal_to_mujoco(model, ("tip", "ground"))
