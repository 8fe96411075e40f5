"""Every registered robot keeps the contract of a morphology, and its model behaves.

The toys, of which one stands on feet and one on wheels, keep it too.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import cache

import mujoco
import numpy as np
import pytest
import toy_robot  # noqa: F401  registers the toys

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.transforms import quat_conjugate, quat_rotate, quat_to_rpy, quat_yaw
from xop_lerobot.morphology.morphology import MORPHOLOGIES, ModelKind, Morphology, make_morphology
from xop_lerobot.morphology.scene import SCENES, build_model

ROBOTS = MORPHOLOGIES.built_in
TOYS = ("toy", "rolling_toy")
TOUCHING = {
    "g1": {f"{side}_foot_{i}" for side in ("left", "right") for i in range(4)},
    "rby1": {f"{s}_{part}" for s in ("left", "right") for part in ("wheel", "caster")},
    "rby1m": {f"{e}_{s}_wheel" for e in ("front", "rear") for s in ("left", "right")},
    "toy": {"sole"},
    "rolling_toy": {f"{s}_{part}" for s in ("left", "right") for part in ("wheel", "caster")},
}
"""Geoms on which each robot stands."""
KINDS: tuple[ModelKind, ...] = ("full", "planning")
CAMERAS = ("head", "left_wrist", "right_wrist", "scene")
SITES = ("head", "left_wrist", "right_wrist", "left_palm", "right_palm")


@cache
def model_of(robot: str, kind: ModelKind, scene: str = "empty") -> mujoco.MjModel:
    return build_model(make_morphology(robot), kind, scene)


def rest_control(morphology: Morphology, model: mujoco.MjModel) -> np.ndarray:
    """Control that holds the standing posture: position servos where they are, wheels still."""
    qpos, control = morphology.standing_qpos(), np.zeros(model.nu)
    for i in range(model.nu):
        if model.actuator_biasprm[i, 1]:
            control[i] = qpos[model.joint(int(model.actuator_trnid[i, 0])).qposadr[0]]
    return control


def standing(robot: str, kind: str, scene: str = "empty") -> tuple[mujoco.MjModel, mujoco.MjData]:
    morphology, model = make_morphology(robot), model_of(robot, kind, scene)
    data = mujoco.MjData(model)
    qpos = morphology.standing_qpos()
    data.qpos[: len(qpos)] = qpos
    data.ctrl[:] = rest_control(morphology, model)
    mujoco.mj_forward(model, data)
    return model, data


def contacts(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[tuple[str, str]]:
    """Names of the bodies in touch, and of the geom, where the floor is one of the two."""
    for contact in data.contact:
        first, second = model.geom(contact.geom1), model.geom(contact.geom2)
        if first.name == "floor":
            yield "floor", second.name
        else:
            yield model.body(first.bodyid[0]).name, model.body(second.bodyid[0]).name


def self_contacts(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    return [pair for pair in contacts(model, data) if pair[0] != "floor"]


def floor_force(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Sum of the normal forces on the floor [N]."""
    force, total = np.zeros(6), 0.0
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, force)
        total += force[0]
    return total


def test_importing_the_robots_loads_no_mujoco() -> None:
    code = (
        "import sys; from xop_lerobot.morphology.morphology import make_morphology;"
        "make_morphology('g1').rest_action(); make_morphology('rby1').standing_qpos();"
        "print('mujoco' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_unknown_names_list_the_choices() -> None:
    with pytest.raises(UnknownName, match="unknown robot 'atlas'. Known: g1, rby1"):
        make_morphology("atlas")
    known = "empty, room, small_room, tabletop"
    with pytest.raises(UnknownName, match=f"unknown scene 'moon'. Known: {known}"):
        build_model(make_morphology("g1"), "full", "moon")


def test_both_robots_are_registered() -> None:
    make_morphology("g1")
    assert {"g1", "rby1"} <= set(MORPHOLOGIES)


@pytest.mark.parametrize("robot", TOYS)
def test_toys_leave_nothing_to_the_interface(robot: str) -> None:
    """What no toy sets, no test would miss where generic code asks for one robot."""
    own = {name for kind in type(make_morphology(robot)).__mro__[:-3] for name in vars(kind)}
    assert set(Morphology.__annotations__) - own == set()


@pytest.mark.parametrize("robot", (*ROBOTS, *TOYS))
class TestContract:
    def test_full_and_planning_have_the_same_joints_and_actuators(self, robot: str) -> None:
        full, planning = model_of(robot, "full"), model_of(robot, "planning")
        for count, get in (("njnt", "joint"), ("nu", "actuator"), ("nbody", "body")):
            n = getattr(full, count)
            assert n == getattr(planning, count)
            names = [[getattr(m, get)(i).name for i in range(n)] for m in (full, planning)]
            assert names[0] == names[1]
            assert all(names[0][1:])
        assert np.array_equal(full.jnt_range, planning.jnt_range)
        assert np.array_equal(full.actuator_ctrlrange, planning.actuator_ctrlrange)
        assert np.array_equal(full.actuator_forcerange, planning.actuator_forcerange)
        assert np.array_equal(full.actuator_gainprm, planning.actuator_gainprm)
        assert np.array_equal(full.body_mass, planning.body_mass)
        assert full.opt.timestep == planning.opt.timestep == 0.005
        assert np.all(full.actuator_forcelimited)

    def test_names_of_the_morphology_exist_in_both_models(self, robot: str) -> None:
        morphology = make_morphology(robot)
        for kind in KINDS:
            model = model_of(robot, kind)
            for site in (*SITES, *morphology.frames.values(), *morphology.contact_points):
                assert model.site(site).id >= 0
            assert model.body(morphology.base_body).id == 1
            for name in morphology.arm_names:
                assert model.actuator(name).id >= 0
            for arm in morphology.arms:
                assert all(model.joint(joint).id >= 0 for joint in arm.joints)
                assert arm.frame in morphology.frames

    def test_rest_posture_is_within_the_limits(self, robot: str) -> None:
        morphology, model = make_morphology(robot), model_of(robot, "planning")
        qpos = morphology.standing_qpos()
        assert qpos.shape == (model.nq,)
        for i in range(1, model.njnt):
            if model.jnt_limited[i]:
                low, high = model.jnt_range[i]
                assert low <= qpos[model.jnt_qposadr[i]] <= high, model.joint(i).name
        for name, angle in morphology.arm_rest.items():
            assert qpos[model.joint(name).qposadr[0]] == angle

    def test_rest_action_has_the_layout_of_the_robot(self, robot: str) -> None:
        morphology = make_morphology(robot)
        action = morphology.rest_action()
        assert action.command.shape == (len(morphology.command_space),)
        assert action.arms.shape == (len(morphology.arm_names),)
        assert action.mode is Mode.STATIONARY
        space = morphology.command_space
        assert np.all(space.low <= space.neutral) and np.all(space.neutral <= space.high)
        assert np.all(space.max_rate > 0)
        assert len(set(morphology.layout.keys)) == len(morphology.layout.keys)

    @pytest.mark.parametrize("kind", KINDS)
    def test_standing_robot_bears_its_weight_on_its_contacts_alone(
        self, robot: str, kind: str
    ) -> None:
        model, data = standing(robot, kind)
        height = data.qpos[2]
        for _ in range(20):
            mujoco.mj_step(model, data)
            assert not self_contacts(model, data)
        touching = {geom for _, geom in contacts(model, data)}
        assert touching == TOUCHING[robot]
        assert abs(data.qpos[2] - height) < 0.005
        weight = 9.81 * mujoco.mj_getTotalmass(model)
        assert floor_force(model, data) == pytest.approx(weight, rel=0.15)

    def test_standing_height_is_the_one_at_equilibrium(self, robot: str) -> None:
        """The contact points penetrate a little, as they do under the robot's weight."""
        model, data = standing(robot, "planning")
        depths = [contact.dist for contact in data.contact]
        assert len(depths) >= 4
        assert -0.001 < min(depths) <= max(depths) < 0

    def test_head_frame_looks_forward_and_hands_point_forward(self, robot: str) -> None:
        _, data = standing(robot, "planning")
        assert np.allclose(data.site("head").xmat.reshape(3, 3), np.eye(3), atol=0.01)
        for side, outwards in (("left", 1.0), ("right", -1.0)):
            axes = data.site(f"{side}_wrist").xmat.reshape(3, 3)
            assert axes[0, 0] > 0.9, "X points along the hand"
            assert axes[1, 2] * outwards > 0.9, "Z leaves the back of the hand"
            palm, wrist = data.site(f"{side}_palm").xpos, data.site(f"{side}_wrist").xpos
            assert (palm - wrist) @ axes[:, 0] > 0.05
            assert wrist[1] * outwards > 0.05


@pytest.mark.parametrize("robot", ROBOTS)
class TestModels:
    def test_planning_model_is_bare(self, robot: str) -> None:
        model = model_of(robot, "planning")
        assert model.ncam == model.nlight == 0
        assert not model.dof_frictionloss.any()
        assert model.ngeom <= 9
        _, data = standing(robot, "planning")
        kinds = set(data.efc_type)
        assert mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF not in kinds
        assert data.nisland == 0

    def test_full_model_is_cheap_to_render(self, robot: str) -> None:
        model = model_of(robot, "full")
        assert model.ngeom <= 62
        assert not model.light_castshadow.any()
        assert not model.mat_reflectance.any()
        assert model.vis.quality.offsamples == 0
        assert model.vis.global_.offwidth >= 640 and model.vis.global_.offheight >= 480

    @pytest.mark.slow
    def test_cameras_see_something(self, robot: str) -> None:
        model, data = standing(robot, "full", "tabletop")
        with mujoco.Renderer(model, 240, 320) as renderer:
            for camera in CAMERAS:
                renderer.update_scene(data, camera)
                picture = renderer.render()
                assert picture.shape == (240, 320, 3)
                assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50, camera
            renderer.update_scene(data, "head")
            red, green, blue = np.moveaxis(renderer.render().astype(int), -1, 0)
        assert np.sum((red > 2 * green) & (red > 2 * blue)) > 200, "the box is in view"

    def test_scene_objects_come_after_the_robot(self, robot: str) -> None:
        alone = model_of(robot, "full")
        for scene in SCENES:
            model = model_of(robot, "full", scene)
            joints = [model.joint(i).name for i in range(model.njnt)]
            assert joints[: alone.njnt] == [alone.joint(i).name for i in range(alone.njnt)]
            assert model.nu == alone.nu
        assert model_of(robot, "full", "tabletop").nq == alone.nq + 7
        assert model_of(robot, "planning", "tabletop").nq == alone.nq

    def test_robot_stands_clear_of_every_scene(self, robot: str) -> None:
        for scene in SCENES:
            model, data = standing(robot, "full", scene)
            robot_bodies = {alone.name for alone in map(model.body, range(1, model.nbody))}
            robot_bodies.discard("box")
            touched = [p for p in self_contacts(model, data) if robot_bodies & set(p)]
            assert not touched, scene


def bend(model: mujoco.MjModel, data: mujoco.MjData, angles: dict[str, float]) -> None:
    for joint, angle in angles.items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_forward(model, data)


@pytest.mark.parametrize(
    ("robot", "clear", "hit"),
    [
        (
            "g1",
            [{"left_shoulder_roll_joint": 2.0}, {"left_shoulder_pitch_joint": -2.2}]
            + [{"left_elbow_joint": 1.5}, {"left_elbow_joint": -0.9}],
            {"left_shoulder_yaw_joint": -1.2, "left_elbow_joint": 0.0},
        ),
        (
            "rby1",
            [{"left_arm_1": 1.5}, {"left_arm_3": -0.5}, {"left_arm_0": -1.5}, {"torso_5": 2.0}],
            {"left_arm_2": -1.5, "left_arm_1": 0.0, "left_arm_3": -2.0},
        ),
    ],
)
def test_arms_collide_with_the_body_only_where_they_reach_it(
    robot: str, clear: list[dict[str, float]], hit: dict[str, float]
) -> None:
    for angles in clear:
        model, data = standing(robot, "full")
        bend(model, data, angles)
        assert not self_contacts(model, data), angles
    model, data = standing(robot, "full")
    bend(model, data, hit)
    assert self_contacts(model, data)
    model, data = standing(robot, "planning")
    bend(model, data, hit)
    assert not self_contacts(model, data)


class TestRby1:
    def drive(self, kind: str, v: float, yaw_rate: float, seconds: float = 3.0) -> mujoco.MjData:
        """Ramp up at the largest rate, hold; the wheels turn about -Y."""
        model, data = standing("rby1", kind)
        rates = make_morphology("rby1").command_space.max_rate
        for i in range(round(seconds / model.opt.timestep)):
            time = i * model.opt.timestep
            now = [
                np.clip(x, -r * time, r * time)
                for x, r in zip((v, yaw_rate), rates[:2], strict=True)
            ]
            data.actuator("right_wheel").ctrl = -(now[0] + 0.265 * now[1]) / 0.1
            data.actuator("left_wheel").ctrl = -(now[0] - 0.265 * now[1]) / 0.1
            mujoco.mj_step(model, data)
        return data

    @pytest.mark.parametrize("kind", KINDS)
    def test_drives_straight(self, kind: str) -> None:
        qpos = self.drive(kind, 0.3, 0.0).qpos
        assert qpos[0] == pytest.approx(0.9 - 0.3 * 0.3 / 1.5 / 2, rel=0.02)
        assert abs(qpos[1]) < 0.005
        assert abs(quat_yaw(qpos[3:7])) < 0.005

    @pytest.mark.parametrize("kind", KINDS)
    def test_turns_in_place_about_the_axle(self, kind: str) -> None:
        data = self.drive(kind, 0.0, 0.5)
        assert quat_yaw(data.qpos[3:7]) == pytest.approx(1.5 - 0.5 * 0.5 / 3.0 / 2, rel=0.02)
        axle = (data.site("left_wheel_center").xpos + data.site("right_wheel_center").xpos) / 2
        assert np.allclose(axle[:2], (0.228, 0), atol=0.01)

    def test_drives_a_curve_backwards(self) -> None:
        data = self.drive("planning", -0.6, -0.8)
        assert quat_yaw(data.qpos[3:7]) == pytest.approx(-2.4 + 0.8 * 0.8 / 3.0 / 2, rel=0.03)
        assert data.qpos[0] < 0

    def test_stays_level_when_it_starts_and_stops_at_full_rate(self) -> None:
        model, data = standing("rby1", "full")
        speed, tilt = 0.0, 0.0
        for i in range(400):
            goal = 1.0 if i < 200 else 0.0
            speed += np.clip(goal - speed, -1.5 * 0.005, 1.5 * 0.005)
            data.ctrl[:2] = -speed / 0.1
            mujoco.mj_step(model, data)
            tilt = max(tilt, *np.abs(quat_to_rpy(data.qpos[3:7])[:2]))
        assert tilt < 0.02
        assert data.qpos[0] > 0.5

    def test_servos_hold_the_ready_pose_against_gravity(self) -> None:
        model, data = standing("rby1", "full")
        ready = data.qpos.copy()
        for _ in range(200):
            mujoco.mj_step(model, data)
        assert np.abs(data.qpos[9:] - ready[9:]).max() < 0.005
        assert np.abs(data.qvel).max() < 0.01
        assert np.abs(data.actuator("torso_2").force) > 50, "the weight is borne by the motors"
        assert floor_force(model, data) == pytest.approx(132.2 * 9.81, rel=0.01)

    @pytest.mark.parametrize("side", ["left", "right"])
    def test_one_target_moves_both_fingers(self, side: str) -> None:
        model, data = standing("rby1", "full")
        letter = side[0]
        for opening in (0.0, 0.03):
            data.actuator(f"{side}_gripper").ctrl = opening
            for _ in range(300):
                mujoco.mj_step(model, data)
            first = data.joint(f"gripper_finger_{letter}1").qpos[0]
            second = data.joint(f"gripper_finger_{letter}2").qpos[0]
            assert second == pytest.approx(opening, abs=0.002)
            assert first == pytest.approx(-opening, abs=0.002)
        span = data.body(f"ee_finger_{letter}1").xpos - data.body(f"ee_finger_{letter}2").xpos
        assert np.linalg.norm(span) == pytest.approx(2 * 0.03 + 0.006, abs=0.003)


class TestRby1M:
    def drive(self, **command: float) -> tuple[np.ndarray, np.ndarray]:
        """Speed up at the largest rate and hold for 3 s.

        Returns:
            Velocity of the base at the end, in its own axes: forward, left, yaw rate. Shape (3,).
            The largest roll and pitch on the way [rad]. Shape (2,).
        """
        morphology = make_morphology("rby1m")
        model, data = standing("rby1m", "full")
        assert morphology.drive is not None
        motors = [model.actuator(name).id for name in morphology.drive.wheels]
        space, tilt = morphology.command_space, np.zeros(2)
        wanted = space.neutral.copy()
        for name, value in command.items():
            wanted[space.index(name)] = value
        for i in range(600):
            reach = space.max_rate * (i + 1) * model.opt.timestep
            twist = np.clip(wanted, -reach, reach)[:3, None]
            data.ctrl[motors] = morphology.drive.compute_speeds(*twist)[0]
            mujoco.mj_step(model, data)
            tilt = np.maximum(tilt, np.abs(quat_to_rpy(data.qpos[3:7])[:2]))
        velocity = quat_rotate(quat_conjugate(data.qpos[3:7]), data.qvel[:3])
        return np.array([*velocity[:2], data.qvel[5]]), tilt

    @pytest.mark.parametrize(
        "command",
        [
            {"vx": 0.5},
            {"vy": 0.5},
            {"vy": -0.5},
            {"yaw_rate": 0.8},
            {"vx": -0.4, "vy": 0.3, "yaw_rate": 0.5},
        ],
    )
    def test_drives_to_any_side_and_stays_level(self, command: dict[str, float]) -> None:
        velocity, tilt = self.drive(**command)
        expected = [command.get(name, 0.0) for name in ("vx", "vy", "yaw_rate")]
        # It turns about the middle of the wheels, 2 mm behind the base.
        assert velocity == pytest.approx(expected, abs=0.003)
        assert tilt.max() < 0.005

    def test_stands_still(self) -> None:
        model, data = standing("rby1m", "full")
        for _ in range(2000):
            mujoco.mj_step(model, data)
        assert np.linalg.norm(data.qpos[:2]) < 1e-4
        assert abs(quat_yaw(data.qpos[3:7])) < 1e-4
        assert np.abs(data.qvel).max() < 1e-3
        torso = make_morphology("rby1m").command_space.neutral[3:9]
        assert np.abs(data.qpos[7:13] - torso).max() < 0.005

    def test_wheel_speeds_are_those_of_the_motors(self) -> None:
        """The speed that a motor feels is the one that the drive asks for, once it is reached."""
        model, data = standing("rby1m", "planning")
        morphology = make_morphology("rby1m")
        assert morphology.drive is not None
        data.qvel[:6] = (0.3, -0.2, 0, 0, 0, 0.4)
        mujoco.mj_forward(model, data)
        twist = [np.array([value]) for value in (0.3, -0.2, 0.4)]
        wanted = morphology.drive.compute_speeds(*twist)[0]
        felt = [data.actuator(name).velocity[0] for name in morphology.drive.wheels]
        assert felt == pytest.approx(wanted, abs=0.02)
