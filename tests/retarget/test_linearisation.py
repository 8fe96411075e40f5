"""Places and derivatives of single configurations, against batched kinematics and differences."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.transforms import quat_exp, rotation_error
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.scene import build_model
from xop_lerobot.retarget.model.kinematics import SiteKinematics
from xop_lerobot.retarget.model.linearisation import Linearisation, Placement, find_site

ROBOTS = ("g1", "rby1")
robots = pytest.mark.parametrize("name", ROBOTS)


@pytest.fixture(scope="module")
def models() -> dict[str, tuple[Morphology, mujoco.MjModel]]:
    made = {name: make_morphology(name) for name in ROBOTS}
    return {name: (robot, build_model(robot, "planning")) for name, robot in made.items()}


def draw_qpos(morphology: Morphology, num: int, seed: int = 0) -> np.ndarray:
    """Configurations about standing, the base anywhere. Shape (num, nq)."""
    rng = np.random.default_rng(seed)
    standing = morphology.standing_qpos()
    qpos = standing + 0.3 * rng.normal(size=(num, len(standing)))
    qpos[:, 3:7] = quat_exp(rng.normal(size=(num, 3)))
    return qpos


def compute_com(model: mujoco.MjModel, qpos: np.ndarray, body: str) -> np.ndarray:
    """Centre of mass of a subtree, as a sum over its bodies. Shape (3,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    root, moment, total = model.body(body).id, np.zeros(3), 0.0
    for i in range(1, model.nbody):
        ancestor = i
        while ancestor > root:
            ancestor = int(model.body_parentid[ancestor])
        if ancestor == root:
            moment, total = moment + model.body_mass[i] * data.xipos[i], total + model.body_mass[i]
    return moment / total


@robots
def test_a_placement_equals_batched_kinematics(models, name):
    morphology, model = models[name]
    poses = tuple(morphology.frames.values())
    points = (*morphology.contact_points, *morphology.hull_points)
    qpos = draw_qpos(morphology, 5)
    got, places, com = Placement(model, poses, points, morphology.base_body).compute(qpos)
    expected = SiteKinematics(model, tuple(dict.fromkeys((*poses, *points))))
    wanted = expected.compute_poses(qpos)
    assert set(got) == set(poses)
    assert set(places) == set(points)
    for site in poses:
        np.testing.assert_allclose(got[site][:, :3], wanted[site][:, :3], atol=1e-12)
        same = np.abs((got[site][:, 3:] * wanted[site][:, 3:]).sum(-1))
        np.testing.assert_allclose(same, 1, atol=1e-12)
    for site in points:
        np.testing.assert_allclose(places[site], wanted[site][:, :3], atol=1e-12)
    for row, configuration in zip(com, qpos, strict=True):
        reference = compute_com(model, configuration, morphology.base_body)
        np.testing.assert_allclose(row, reference, atol=1e-12)


def test_what_is_not_asked_for_is_not_there(models):
    morphology, model = models["g1"]
    poses, points, com = Placement(model, ()).compute(draw_qpos(morphology, 2))
    assert (poses, points, com.shape) == ({}, {}, (0, 3))


def test_placements_share_no_memory(models):
    morphology, model = models["rby1"]
    placement = Placement(model, ("head",), ("left_palm",), morphology.base_body)
    first = placement.compute(draw_qpos(morphology, 2))
    kept = first[0]["head"].copy(), first[1]["left_palm"].copy(), first[2].copy()
    placement.compute(draw_qpos(morphology, 2, seed=1))
    for before, now in zip(kept, (first[0]["head"], first[1]["left_palm"], first[2]), strict=True):
        np.testing.assert_array_equal(before, now)


@robots
@pytest.mark.parametrize("frame", ["head", "left_wrist"])
def test_a_sites_jacobian_equals_finite_differences(models, name, frame):
    morphology, model = models[name]
    linearisation = Linearisation(model)
    site = find_site(model, morphology.frames[frame])
    qpos = draw_qpos(morphology, 1, seed=2)[0]

    def place(configuration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        linearisation.update(configuration)
        position, quat, _, _ = linearisation.compute_site(site)
        return position.copy(), quat

    linearisation.update(qpos)
    _, _, linear, angular = linearisation.compute_site(site)
    for i, direction in enumerate(np.eye(model.nv)):
        moved = []
        for step in (1e-6, -1e-6):
            configuration = qpos.copy()
            mujoco.mj_integratePos(model, configuration, direction, step)
            moved.append(place(configuration))
        (ahead, turned), (behind, before) = moved
        np.testing.assert_allclose(linear[:, i], (ahead - behind) / 2e-6, atol=1e-8)
        turn = rotation_error(turned, before) / 2e-6  # in world axes
        np.testing.assert_allclose(angular[:, i], turn, atol=1e-8)


@robots
def test_the_centre_of_mass_and_its_jacobian(models, name):
    morphology, model = models[name]
    linearisation, body = Linearisation(model), model.body(morphology.base_body).id
    qpos = draw_qpos(morphology, 1, seed=3)[0]
    linearisation.update(qpos)
    com, jacobian = linearisation.compute_com(body)
    np.testing.assert_allclose(com, compute_com(model, qpos, morphology.base_body), atol=1e-12)
    for i, direction in enumerate(np.eye(model.nv)):
        ahead, behind = qpos.copy(), qpos.copy()
        mujoco.mj_integratePos(model, ahead, direction, 1e-6)
        mujoco.mj_integratePos(model, behind, direction, -1e-6)
        moved = [compute_com(model, q, morphology.base_body) for q in (ahead, behind)]
        np.testing.assert_allclose(jacobian[:, i], (moved[0] - moved[1]) / 2e-6, atol=1e-8)


def test_an_unknown_site_lists_the_known_ones(models):
    with pytest.raises(UnknownName, match=r"^unknown site 'nose'\. Known: .*head.*left_palm"):
        Placement(models["g1"][1], ("nose",))
