"""Behaviour of the simulated plant: time, state, falls, collisions, pictures, the browser view."""

from __future__ import annotations

import logging
import re
import threading
import urllib.request
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import pytest
from ports import find_port

from xop_lerobot.core.command import CommandDim, CommandSpace, Mode
from xop_lerobot.core.errors import BadShape, BadValue, UnknownName
from xop_lerobot.core.transforms import quat_from_rpy
from xop_lerobot.morphology.contacts import Feet
from xop_lerobot.morphology.morphology import ArmChain, Morphology, make_morphology
from xop_lerobot.plant.config import NOISE_PRESETS, NoiseConfig, SimulationConfig
from xop_lerobot.plant.plant import Plant
from xop_lerobot.plant.rendering import RenderingUnavailable, choose_backends, make_gl_context
from xop_lerobot.plant.simulation import Simulation

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import ModelKind
    from xop_lerobot.morphology.tuning import MpcConfig

PAGE = Path(__file__).parents[2] / "docs" / "how_it_works" / "simulation.md"

TOY = """
<mujoco model="toy">
  <worldbody>
    <body name="base" pos="0 0 .1">
      <freejoint name="root"/>
      <geom name="hull" type="box" size=".2 .15 .1" mass="5"/>
      <site name="head" pos="0 0 .1"/>
      <site name="corner" pos=".2 .15 -.1"/>
      <body name="upper" pos=".2 0 .2">
        <joint name="shoulder" axis="0 1 0" damping="1" range="-3 3"/>
        <geom name="upper" type="capsule" fromto=".03 0 0 .3 0 0" size=".03" mass=".3"/>
        <body name="hand" pos=".33 0 0">
          <joint name="elbow" axis="0 1 0" damping="1" range="-3 3"/>
          <geom name="hand" type="sphere" size=".05" mass=".2" rgba=".9 .1 .1 1"/>
          <site name="left_wrist"/>
          <site name="right_wrist"/>
        </body>
      </body>
    </body>
    <camera name="scene" pos="2 -1.5 1.2" xyaxes=".6 .8 0 -.3 .25 .92"/>
    <camera name="top" pos="0 0 2"/>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" kv="4"/>
    <motor name="elbow" joint="elbow"/>
  </actuator>
</mujoco>
"""


class Toy(Morphology):
    """A box with an arm of two joints; a third robot, as far as the plant is concerned."""

    name = "toy"
    command_space = CommandSpace((CommandDim("lift", "lift.pos", "rad", -1, 1, 0, 1),))
    policies = ()
    frames = {"head": "head", "left_wrist": "left_wrist", "right_wrist": "right_wrist"}
    base_body = "base"
    arms = (ArmChain("left_wrist", ("shoulder", "elbow")),)
    arm_rest: dict[str, float] = {}
    contact_points = ("corner",)
    fall_height = 0.05
    fall_tilt = 0.8
    contact_kind = Feet()

    def build_spec(self, kind: ModelKind) -> mujoco.MjSpec:
        del kind
        return mujoco.MjSpec.from_string(TOY)

    def standing_qpos(self) -> np.ndarray:
        return np.array([0, 0, 0.1, 1, 0, 0, 0, -0.5, 0.2])

    def mpc_config(self, mode: Mode) -> MpcConfig:
        raise NotImplementedError


def make_toy(**settings: Any) -> Simulation:
    return Simulation(Toy(), SimulationConfig(**settings))


def run(simulation: Simulation, steps: int = 50) -> list[np.ndarray]:
    """Swing the arm and return all that was measured."""
    rows = []
    for k in range(steps):
        simulation.apply(np.array([0.3 * np.sin(0.2 * k) - 0.5, 0.1]))
        simulation.step(0.02)
        m = simulation.measure()
        rows.append(np.concatenate([m.qpos, m.qvel, m.true_qpos, m.true_qvel, m.effort]))
    return rows


@pytest.fixture(scope="module")
def g1() -> Simulation:
    return Simulation(make_morphology("g1"), SimulationConfig(scene="tabletop"))


# -- time ----------------------------------------------------------------------------------


def test_step_is_a_whole_number_of_physics_steps() -> None:
    with pytest.raises(BadValue) as error:
        make_toy().step(0.012)
    assert str(error.value) == (
        "a step of 0.012 s is not a whole multiple of the physics step of 0.005 s"
    )


@pytest.mark.parametrize("dt", [-0.005, float("nan"), float("inf")])
def test_time_only_goes_forward(dt: float) -> None:
    with pytest.raises(BadValue):
        make_toy().step(dt)


def test_time_is_exact() -> None:
    simulation = make_toy()
    for _ in range(250):
        simulation.step(0.02)
    assert simulation.measure().time == 1000 * 0.005
    assert simulation.data.time == pytest.approx(5.0)


def test_one_long_step_is_many_short_ones() -> None:
    long, short = make_toy(noise="harsh"), make_toy(noise="harsh")
    long.step(0.1)
    for _ in range(20):
        short.step(0.005)
    assert np.array_equal(long.measure().qpos, short.measure().qpos)
    assert np.array_equal(long.measure().true_qvel, short.measure().true_qvel)


def test_no_time_changes_nothing() -> None:
    simulation = make_toy()
    simulation.step(0.1)
    before = simulation.measure()
    simulation.step(0.0)
    assert np.array_equal(before.true_qpos, simulation.measure().true_qpos)
    assert before.time == simulation.time


def test_physics_step_is_configurable() -> None:
    simulation = make_toy(time_step=0.0025)
    simulation.step(0.02)
    assert simulation.model.opt.timestep == 0.0025
    assert simulation.data.time == pytest.approx(0.02)


# -- state ---------------------------------------------------------------------------------


def test_it_is_a_plant_that_starts_at_rest() -> None:
    simulation = make_toy()
    assert isinstance(simulation, Plant)
    m = simulation.measure()
    assert np.array_equal(m.qpos, Toy().standing_qpos())
    assert not m.qvel.any()
    assert m.effort.shape == (2,)
    assert (m.time, m.fallen, m.collision, m.contacts) == (0.0, False, False, ())


def test_position_actuators_hold_the_start_posture() -> None:
    simulation = make_toy()
    assert simulation.data.ctrl.tolist() == [-0.5, 0.0]  # a motor has no position to hold


def test_noise_off_measures_the_truth() -> None:
    simulation = make_toy()
    run(simulation)
    m = simulation.measure()
    assert np.array_equal(m.qpos, m.true_qpos)
    assert np.array_equal(m.qvel, m.true_qvel)


@pytest.mark.parametrize("noise", ["off", "mild", "harsh"])
def test_reset_with_a_seed_repeats_bit_for_bit(noise: str) -> None:
    simulation = make_toy(noise=noise)
    simulation.reset(3)
    first = run(simulation)
    simulation.reset(3)
    assert np.array_equal(first, run(simulation))
    other = make_toy(noise=noise, seed=9)
    other.reset(3)
    assert np.array_equal(first, run(other))


def test_reset_with_another_seed_changes_the_noise_alone() -> None:
    simulation = make_toy(noise="mild")
    measurements = []
    for seed in (3, 4):
        simulation.reset(seed)
        measurements.append(simulation.measure())
    assert not np.array_equal(measurements[0].qpos, measurements[1].qpos)
    assert np.array_equal(measurements[0].true_qpos, measurements[1].true_qpos)


def test_episodes_of_a_session_differ_and_the_session_repeats() -> None:
    def episodes(seed: int) -> list[np.ndarray]:
        simulation = make_toy(noise="mild", seed=seed)
        readings = []
        for _ in range(3):
            simulation.reset()
            readings.append(simulation.measure().qpos)
        return readings

    first, again, other = episodes(1), episodes(1), episodes(2)
    assert np.array_equal(first, again)
    assert len({reading.tobytes() for reading in first + other}) == 6


def test_reading_changes_nothing() -> None:
    often, once = make_toy(noise="harsh"), make_toy(noise="harsh")
    for _ in range(10):
        for _ in range(3):
            often.measure()
        often.step(0.02)
        once.step(0.02)
    assert np.array_equal(often.measure().qpos, often.measure().qpos)
    assert np.array_equal(often.measure().qpos, once.measure().qpos)


def test_measured_arrays_are_not_shared() -> None:
    simulation = make_toy()
    first, second = simulation.measure(), simulation.measure()
    arrays = [
        getattr(m, name)
        for m in (first, second)
        for name in ("qpos", "qvel", "effort", "true_qpos", "true_qvel")
    ] + [simulation.data.qpos, simulation.data.qvel, simulation.data.actuator_force]
    for i, one in enumerate(arrays):
        for other in arrays[:i]:
            assert not np.shares_memory(one, other)


def test_effort_is_the_actuators_force() -> None:
    simulation = make_toy()
    simulation.apply(np.array([-0.5, 0.7]))
    simulation.step(0.005)
    effort = simulation.measure().effort
    assert effort[1] == pytest.approx(0.7)
    assert effort[0] == pytest.approx(0, abs=1e-6)  # on target and at rest when the step began


def test_targets_must_fit() -> None:
    simulation = make_toy()
    with pytest.raises(BadShape) as error:
        simulation.apply(np.zeros(3))
    assert str(error.value) == "targets must have shape (2,), got (3,)"
    with pytest.raises(BadValue, match="targets must be finite"):
        simulation.apply(np.array([0, np.nan]))


def test_set_state_moves_the_robot_and_its_sensors() -> None:
    simulation = make_toy(noise="harsh")
    qpos = np.array([5, -4, 0.5, 0, 0, 0, 2, 0.1, 0.2])
    simulation.set_state(qpos, np.arange(8))
    m = simulation.measure()
    assert np.array_equal(m.true_qpos[3:7], [0, 0, 0, 1])
    assert np.array_equal(m.true_qvel, np.arange(8))
    np.testing.assert_allclose(m.qpos[:3], qpos[:3], atol=0.2)
    np.testing.assert_allclose(simulation.get_site_pose("head")[:3], [5, -4, 0.6])


def test_site_positions_belong_to_the_measured_position() -> None:
    simulation = make_toy()
    run(simulation, 7)
    fresh = mujoco.MjData(simulation.model)
    fresh.qpos[:] = simulation.measure().true_qpos
    mujoco.mj_forward(simulation.model, fresh)
    pose = simulation.get_site_pose("left_wrist")
    np.testing.assert_allclose(pose[:3], fresh.site("left_wrist").xpos, atol=1e-12)
    with pytest.raises(UnknownName) as error:
        simulation.get_site_pose("tail")
    known = "corner, head, left_wrist, right_wrist"
    assert str(error.value) == f"unknown site 'tail'. Known: {known}"


def test_unknown_scene_lists_the_known_ones() -> None:
    with pytest.raises(UnknownName, match="unknown scene 'moon'. Known: .*empty.*tabletop"):
        make_toy(scene="moon")


def test_scene_objects_are_not_the_robots_state() -> None:
    simulation = make_toy(scene="tabletop")
    assert simulation.model.nq == 9 + 7
    assert simulation.measure().qpos.shape == (9,)
    assert simulation.measure().qvel.shape == (8,)
    assert simulation.object_names == ("box",)
    simulation.set_object_pose("box", np.array([0.7, 0.1, 0.79, 1, 0, 0, 1]))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        simulation.get_object_pose("box"), [0.7, 0.1, 0.79, half, 0, 0, half]
    )
    simulation.step(0.5)
    assert simulation.get_object_pose("box")[2] == pytest.approx(0.78, abs=0.005)
    with pytest.raises(UnknownName) as error:
        simulation.get_object_pose("ball")
    assert str(error.value) == "unknown object 'ball'. Known: box"
    simulation.reset()
    assert simulation.get_object_pose("box")[1] == 0


def test_the_planning_model_can_be_the_plant() -> None:
    simulation = Simulation(make_morphology("g1"), kind="planning")
    simulation.step(0.02)
    assert simulation.measure().qpos.shape == make_morphology("g1").standing_qpos().shape


# -- falls and collisions ------------------------------------------------------------------


def test_a_fall_is_remembered_until_reset() -> None:
    simulation = make_toy()
    tilted = Toy().standing_qpos()
    tilted[2:7] = [0.4, *quat_from_rpy(0, 1.0, 0)]
    simulation.set_state(tilted)
    assert simulation.fallen
    simulation.set_state(Toy().standing_qpos())
    assert not simulation.fallen
    assert simulation.has_fallen
    assert simulation.measure().fallen
    simulation.reset()
    assert not simulation.measure().fallen


@pytest.mark.parametrize(("pitch", "fallen"), [(0.7, False), (0.9, True), (-0.9, True)])
def test_tilt_counts_from_its_limit_on(pitch: float, fallen: bool) -> None:
    simulation = make_toy()
    qpos = Toy().standing_qpos()
    qpos[2:7] = [1.0, *quat_from_rpy(0, pitch, 2.0)]
    simulation.set_state(qpos)
    assert simulation.fallen is fallen


def test_resting_on_the_ground_is_no_collision() -> None:
    simulation = make_toy()
    simulation.step(0.5)
    assert simulation.data.ncon > 0
    assert not simulation.measure().collision


def test_a_hand_on_the_ground_is_a_collision() -> None:
    simulation = make_toy()
    qpos = Toy().standing_qpos()
    qpos[7:] = [1.0, 0.0]
    simulation.set_state(qpos)
    m = simulation.measure()
    assert m.collision
    assert ("hand", "floor") in m.contacts


def test_touching_oneself_is_a_collision() -> None:
    simulation = make_toy()
    qpos = Toy().standing_qpos()
    qpos[2], qpos[7:] = 1.0, [2.9, 0.0]
    simulation.set_state(qpos)
    assert ("hand", "base") in simulation.measure().contacts


def test_a_short_touch_within_a_step_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = make_toy()
    answers = iter([{("hand", "floor")}, set(), set(), set(), set()])
    monkeypatch.setattr(simulation._contacts, "find_collisions", lambda _: next(answers))
    simulation.step(0.02)
    assert simulation.measure().contacts == (("hand", "floor"),)
    simulation.step(0.005)
    assert not simulation.measure().collision


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_a_robot_stands_without_collision(robot: str) -> None:
    simulation = Simulation(make_morphology(robot))
    m = simulation.measure()
    assert (m.fallen, m.contacts) == (False, ())
    simulation.step(0.1)
    assert simulation.data.ncon > 0
    m = simulation.measure()
    assert (m.fallen, m.contacts) == (False, ())


def test_g1_without_a_policy_falls() -> None:
    simulation = Simulation(make_morphology("g1"))
    simulation.step(2.5)
    assert simulation.measure().fallen
    assert any(floor == "floor" for _, floor in simulation.measure().contacts)


@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_g1_tilted_has_fallen(g1: Simulation, axis: str) -> None:
    g1.reset()
    qpos = g1.morphology.standing_qpos()
    angles = {"roll": 0.0, "pitch": 0.0} | {axis: 1.2}
    qpos[3:7] = quat_from_rpy(angles["roll"], angles["pitch"], 0)
    g1.set_state(qpos)
    assert g1.measure().fallen


def test_g1_arm_into_the_torso_is_a_collision(g1: Simulation) -> None:
    g1.reset()
    qpos = g1.morphology.standing_qpos()
    for name, angle in (
        ("left_shoulder_roll_joint", 0.0),
        ("left_shoulder_yaw_joint", -1.2),
        ("left_elbow_joint", 0.2),
    ):
        qpos[g1.model.joint(name).qposadr[0]] = angle
    g1.set_state(qpos)
    contacts = g1.measure().contacts
    assert contacts
    assert all("floor" not in pair and any(b.startswith("left") for b in pair) for pair in contacts)
    assert not g1.measure().fallen


def test_g1_walking_into_the_table_is_a_collision(g1: Simulation) -> None:
    g1.reset()
    qpos = g1.morphology.standing_qpos()
    qpos[0] = 0.5
    g1.set_state(qpos)
    assert any(what == "table_top" for _, what in g1.measure().contacts)


def test_a_diverged_simulation_counts_as_fallen(caplog: pytest.LogCaptureFixture) -> None:
    simulation = make_toy(noise="mild")
    simulation.step(0.1)
    qvel = np.zeros(8)
    qvel[6] = 1e11
    simulation.set_state(Toy().standing_qpos(), qvel)
    with caplog.at_level(logging.ERROR):
        simulation.step(0.1)
    assert (
        "the simulation of 'toy' diverged at 0.105 s (fastest joint before: 'shoulder' at 1e+11); "
        "the robot is frozen and counts as fallen until reset"
    ) in caplog.text
    m = simulation.measure()
    assert m.fallen
    assert m.time == 0.2
    assert all(np.isfinite(a).all() for a in (m.qpos, m.qvel, m.true_qpos, m.true_qvel, m.effort))
    simulation.reset()
    assert not simulation.measure().fallen
    simulation.step(0.1)
    assert not simulation.diverged


def test_physics_warnings_leave_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    simulation = make_toy()
    simulation.set_state(Toy().standing_qpos(), np.full(8, 1e11))
    simulation.step(0.1)
    assert simulation.diverged
    assert not list(tmp_path.iterdir())


# -- pictures ------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_every_camera_gives_a_picture(robot: str) -> None:
    simulation = Simulation(make_morphology(robot), SimulationConfig(scene="tabletop"))
    assert {"head", "scene"} <= set(simulation.camera_names)
    for camera in simulation.camera_names:
        picture = simulation.render(camera)
        assert picture.shape == (240, 320, 3)
        assert picture.dtype == np.uint8
        assert picture.flags.c_contiguous
        assert picture.std() > 10, f"{camera} shows nothing"
    simulation.close()
    simulation.close()


def test_pictures_show_the_robot_where_it_is() -> None:
    simulation = make_toy(width=160, height=120)
    first = simulation.render("scene")
    assert first.shape == (120, 160, 3)
    assert _count_red(first) > 20
    gone = Toy().standing_qpos()
    gone[0] = -30
    simulation.set_state(gone)
    assert _count_red(simulation.render("scene")) == 0
    assert not np.shares_memory(first, simulation.render("scene"))
    simulation.reset()
    assert np.array_equal(simulation.render("scene"), first)
    simulation.close()


def _count_red(picture: np.ndarray) -> int:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return int(((red > 2 * green) & (red > 2 * blue) & (red > 60)).sum())


def test_a_picture_may_be_larger_than_the_models_buffer() -> None:
    simulation = make_toy(width=800, height=600)
    assert simulation.render("top").shape == (600, 800, 3)
    simulation.close()


def test_unknown_camera_lists_the_known_ones() -> None:
    with pytest.raises(UnknownName) as error:
        make_toy().render("rear")
    assert str(error.value) == "unknown camera 'rear'. Known: scene, top"


def test_rendering_leaves_the_physics_alone() -> None:
    seen, unseen = make_toy(noise="mild"), make_toy(noise="mild")
    for simulation in (seen, unseen):
        for _ in range(10):
            simulation.step(0.02)
            if simulation is seen:
                simulation.render("top")
    assert np.array_equal(seen.measure().qpos, unseen.measure().qpos)
    assert np.array_equal(seen.data.qacc_warmstart, unseen.data.qacc_warmstart)
    seen.close()


def test_every_thread_may_render() -> None:
    simulation = make_toy()
    pictures = [simulation.render("scene")]
    threads = [
        threading.Thread(target=lambda: pictures.append(simulation.render("scene")))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    pictures.append(simulation.render("scene"))
    for thread in threads:
        thread.join()
    assert len(pictures) == 4
    assert all(np.array_equal(picture, pictures[0]) for picture in pictures)
    simulation.close()


def test_without_opengl_the_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    with pytest.raises(RenderingUnavailable) as error:
        make_gl_context(320, 240)
    assert str(error.value) == (
        "images can't be rendered on this machine (egl: libEGL is not installed; "
        "osmesa: libOSMesa is not installed). Install Mesa's EGL: "
        "'apt-get install libegl1 libgl1-mesa-dri' (Debian, Ubuntu), "
        "'dnf install mesa-libEGL mesa-dri-drivers' (Fedora), or run without cameras."
    )


@pytest.mark.parametrize(
    ("environment", "backends"),
    [
        ({}, ["egl", "osmesa"]),
        ({"DISPLAY": ":0"}, ["egl", "osmesa", "glfw"]),
        ({"MUJOCO_GL": "OSMesa"}, ["osmesa"]),
        ({"MUJOCO_GL": "off"}, []),
    ],
)
def test_choice_of_opengl(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], backends: list[str]
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert choose_backends() == backends


# -- watching ------------------------------------------------------------------------------


def test_browser_view_follows_the_simulation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from xop_lerobot.plant.viewer import BrowserViewer  # loads a web server

    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    simulation = make_toy(viewer=True, viewer_port=find_port())
    viewer = simulation._viewer
    assert isinstance(viewer, BrowserViewer)
    assert f"The simulation can be watched at {viewer.url}" in capsys.readouterr().out
    assert b"<html" in urllib.request.urlopen(viewer.url, timeout=60).read().lower()

    names = {simulation.model.body(body).name for body in viewer.body_ids}
    assert names == {"base", "upper", "hand"}
    hand = simulation.model.body("hand").id
    before = viewer.get_shown_pose(hand)
    now = viewer._clock()
    viewer._clock = lambda: now + 1.0
    simulation.apply(np.array([0.5, 0.0]))
    simulation.step(0.2)
    shown = viewer.get_shown_pose(hand)
    np.testing.assert_allclose(shown[:3], simulation.data.xpos[hand], atol=1e-6)
    assert np.linalg.norm(shown[:3] - before[:3]) > 0.02
    # Within 50 ms of wall time the picture is not renewed again.
    simulation.step(0.2)
    assert np.array_equal(viewer.get_shown_pose(hand), shown)

    simulation.close()
    simulation.close()
    simulation.step(0.02)
    with pytest.raises(OSError):
        urllib.request.urlopen(viewer.url, timeout=2)


@pytest.mark.parametrize("robot", ["g1", "rby1"])
def test_browser_meshes_are_as_large_as_the_geoms(robot: str) -> None:
    from xop_lerobot.plant.viewer import build_body_meshes  # loads a web server

    simulation = Simulation(make_morphology(robot))
    model = simulation.model
    meshes = build_body_meshes(model)
    assert len(meshes) > 15
    for body, mesh in meshes.items():
        geoms = [
            g
            for g in range(model.ngeom)
            if model.geom_bodyid[g] == body and model.geom_group[g] < 3
        ]
        reach = max(float(np.linalg.norm(model.geom_pos[g]) + model.geom_rbound[g]) for g in geoms)
        farthest = float(np.linalg.norm(mesh.vertices, axis=1).max())
        assert 0.4 * reach < farthest <= reach + 1e-6, model.body(body).name


def test_the_documented_example_runs() -> None:
    page = PAGE.read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert names["picture"].shape == (240, 320, 3)
    assert names["measured"].time == 0.02


def test_the_documented_settings_are_the_real_ones() -> None:
    page = PAGE.read_text(encoding="utf-8")
    documented = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| `.*?\|", page, re.MULTILINE))))
    settings = {setting.name for setting in fields(NoiseConfig)}
    assert settings == documented & settings
    for name, *values in re.findall(
        r"^\| `(\w+)`[^|]*\|[^|]*\| ([\d.]+) \| ([\d.]+)[^|]*\| ([\d.]+)[^|]*\|$",
        page,
        re.MULTILINE,
    ):
        shown = dict(zip(("off", "mild", "harsh"), map(float, values), strict=True))
        for preset, value in shown.items():
            assert NOISE_PRESETS[preset].get(name) == pytest.approx(value, abs=2e-4), name


def test_a_display_that_does_not_answer_leads_to_the_browser_view(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from xop_lerobot.plant.viewer import BrowserViewer  # loads a web server

    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":9797")
    simulation = make_toy(viewer=True, viewer_port=find_port())
    try:
        assert isinstance(simulation._viewer, BrowserViewer)
        assert "no window can be opened" in caplog.text
        assert "showing the browser view" in caplog.text
    finally:
        simulation.close()
