"""Classification of a robot's contacts: support on the ground, or collision with anything else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology

STANDING_GAP = 0.005
"""Distance to the ground in the standing posture up to which a geom counts as support [m]."""

_OTHER, _FLOOR, _SUPPORT, _ROBOT = range(4)


class ContactTable:
    """Distinguishes collisions from the support of feet, wheels and casters on the ground.

    Every geom is floor (a static plane or height field), support (a robot's geom that may touch
    the floor), robot, or other. A contact of the robot is a collision unless it is support on
    floor. Support geoms are those that touch the floor in the standing posture, and all geoms of
    bodies with a contact point, since a foot may roll onto its edge.

    Args:
        model: Model with the robot in it.
        morphology: The robot.
    """

    def __init__(self, model: mujoco.MjModel, morphology: Morphology) -> None:
        root = model.body_rootid[model.body(morphology.base_body).id]
        self.robot_bodies = np.flatnonzero(model.body_rootid == root)
        is_robot = np.isin(model.geom_bodyid, self.robot_bodies)
        is_floor = ~is_robot & (model.body_weldid[model.geom_bodyid] == 0)
        is_floor &= np.isin(
            model.geom_type, [mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD]
        )
        kind = np.full(model.ngeom, _OTHER)
        kind[is_robot] = _ROBOT
        kind[is_floor] = _FLOOR
        base = model.body(morphology.base_body).id
        feet = {int(model.site(name).bodyid[0]) for name in morphology.contact_points} - {base}
        kind[is_robot & np.isin(model.geom_bodyid, list(feet))] = _SUPPORT
        kind[list(_find_standing_geoms(model, morphology, is_robot, is_floor))] = _SUPPORT
        self._kind = kind
        # Entry (i, j): whether a contact of kind i with kind j is a collision of the robot.
        table = np.zeros((4, 4), dtype=bool)
        table[_SUPPORT:, :] = table[:, _SUPPORT:] = True
        table[_SUPPORT, _FLOOR] = table[_FLOOR, _SUPPORT] = False
        self._is_collision = table
        self._names = [_describe(model, geom) for geom in range(model.ngeom)]

    def find_collisions(self, data: mujoco.MjData) -> set[tuple[str, str]]:
        """Pairs of names of the colliding bodies, the robot's first; static geoms by geom name."""
        if data.ncon == 0:
            return set()
        pairs = data.contact.geom  # (ncon, 2), -1 for a flex (deformable)
        rigid = (pairs >= 0).all(axis=1) & (data.contact.dist <= 0)
        kinds = self._kind[pairs]
        hits = pairs[rigid & self._is_collision[kinds[:, 0], kinds[:, 1]]]
        return {self._name_pair(int(a), int(b)) for a, b in hits}

    def _name_pair(self, a: int, b: int) -> tuple[str, str]:
        if self._kind[a] < self._kind[b]:  # the robot's part comes first
            a, b = b, a
        return self._names[a], self._names[b]


def _describe(model: mujoco.MjModel, geom: int) -> str:
    body = int(model.geom_bodyid[geom])
    if body == 0:
        return model.geom(geom).name or f"geom {geom}"
    return model.body(body).name or f"body {body}"


def _find_standing_geoms(
    model: mujoco.MjModel, morphology: Morphology, is_robot: np.ndarray, is_floor: np.ndarray
) -> Iterable[int]:
    """Yield the robot's geoms that touch the floor in the standing posture."""
    data = mujoco.MjData(model)
    standing = morphology.standing_qpos()
    data.qpos[: standing.size] = standing
    mujoco.mj_kinematics(model, data)
    for geom in np.flatnonzero(is_robot):
        for floor in np.flatnonzero(is_floor):
            collide = model.geom_contype[geom] & model.geom_conaffinity[floor]
            collide |= model.geom_contype[floor] & model.geom_conaffinity[geom]
            if not collide:
                continue
            gap = mujoco.mj_geomDistance(model, data, int(geom), int(floor), 1.0, None)
            if gap <= STANDING_GAP:
                yield int(geom)
