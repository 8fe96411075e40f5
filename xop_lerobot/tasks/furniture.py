"""Furniture and objects of tasks: adding them to a model, placing and observing them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from xop_lerobot.core.errors import UnknownName
from xop_lerobot.core.transforms import make_pose
from xop_lerobot.morphology.links import FLOOR_BIT, OBJECT_BIT

if TYPE_CHECKING:
    from xop_lerobot.plant.simulation import Simulation

PARKING = (30.0, 30.0)
"""Position of everything before it is placed, far from any robot [m]."""

SHORTEST_STEPS = 2
"""Shortest time constant of a contact that MuJoCo accepts [physics steps]."""

SLIDING, TORSION, ROLLING = 0.6, 0.005, 0.0001
"""Friction of furniture: sliding as of lacquered wood; torsion and rolling are MuJoCo's
defaults."""


def add_furniture_body(spec: mujoco.MjSpec, name: str, index: int = 0) -> mujoco.MjsBody:
    """Add a static body that can be placed; `index` separates parked ones."""
    return spec.worldbody.add_body(
        name=name, mocap=True, pos=(PARKING[0] + 3 * index, PARKING[1], 0)
    )


def add_object_body(
    spec: mujoco.MjSpec, name: str, height: float, index: int = 0
) -> mujoco.MjsBody:
    """Add a free body, parked on the floor.

    Args:
        spec: The model.
        name: Its name.
        height: Height of its frame above the floor while parked [m].
        index: Separates parked objects.
    """
    body = spec.worldbody.add_body(name=name, pos=(PARKING[0] + 3 * index, PARKING[1] + 6, height))
    body.add_freejoint(name=f"{name}_joint")
    return body


def add_solid(
    body: mujoco.MjsBody,
    name: str,
    kind: str,
    size: tuple[float, ...],
    pos: tuple[float, ...],
    colour: tuple[float, ...],
    friction: tuple[float, float, float] = (SLIDING, TORSION, ROLLING),
) -> mujoco.MjsGeom:
    """Add a collision geom that touches robots and objects, but no floor or furniture.

    Args:
        body: Body of the furniture.
        name: Name of the geom.
        kind: ``"box"``, ``"cylinder"`` or another primitive type.
        size: Size in MuJoCo's convention [m].
        pos: Centre in the body frame [m].
        colour: Red, green, blue, opacity.
        friction: Sliding, torsional [m], rolling [m].
    """
    return body.add_geom(
        name=name,
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=[*size, 0, 0][:3],
        pos=pos,
        rgba=colour,
        friction=friction,
        contype=OBJECT_BIT,
        conaffinity=0,
    )


def add_look(
    body: mujoco.MjsBody,
    name: str,
    kind: str,
    size: tuple[float, ...],
    pos: tuple[float, ...],
    colour: tuple[float, ...],
) -> mujoco.MjsGeom:
    """Add a visual geom without collision or mass."""
    geom = add_solid(body, name, kind, size, pos, colour)
    geom.contype = geom.conaffinity = 0
    geom.mass = 0
    return geom


def add_grip(
    spec: mujoco.MjSpec,
    geom: mujoco.MjsGeom,
    sites: Iterable[str],
    friction: tuple[float, float, float],
    compliance: tuple[float, float],
) -> None:
    r"""Let hands hold a solid without slow creep, however soft its contacts are.

    MuJoCo's contacts impose :math:`J\dot v = -bv` on sliding, without :math:`\dot J v`: an object
    carried in a circle at ω slides outwards at :math:`\omega^2 r/b`, however hard it is held. With
    the time constant of a soft contact that is a centimetre per second. So the friction of hands
    gets its own time constant, the shortest that MuJoCo accepts.

    Args:
        spec: The model.
        geom: The solid's geom.
        sites: A site on each hand; the hand is the body that carries it, with its descendants.
        friction: Sliding, torsional [m], rolling [m].
        compliance: Time constant [s] and damping ratio normal to the contact.

    References:
        MuJoCo's documentation, Computation, "Constraint model" (reference acceleration), and
        XML reference, contact/pair, ``solreffriction``.
    """
    sliding, torsion, rolling = friction
    for site in sites:
        hand = next(each for each in spec.sites if each.name == site).parent
        for i, part in enumerate(hand.find_all(mujoco.mjtObj.mjOBJ_GEOM)):
            if not part.contype:
                continue
            part.name = part.name or f"{hand.name}_part_{i}"
            spec.add_pair(
                geomname1=geom.name,
                geomname2=part.name,
                condim=geom.condim,
                friction=[sliding, sliding, torsion, rolling, rolling],
                solref=compliance,
                solreffriction=(SHORTEST_STEPS * spec.option.timestep, 1.0),
            )


OBJECT_CONTACT = {"contype": OBJECT_BIT, "conaffinity": FLOOR_BIT | OBJECT_BIT}
"""Collision bits of a free object: it touches floor, robots and furniture."""


def place(plant: Simulation, name: str, position: np.ndarray, quat: np.ndarray) -> None:
    """Place furniture; the caller updates derived positions afterwards with `Simulation.rearrange`.

    Args:
        plant: The simulation.
        name: Name of the furniture.
        position: Position of its frame [m]. Shape (3,).
        quat: Orientation, wxyz. Shape (4,).

    Raises:
        UnknownName: If there is no such furniture; lists the known ones.
    """
    model = plant.model
    known = [model.body(i).name for i in range(model.nbody) if model.body_mocapid[i] >= 0]
    if name not in known:
        raise UnknownName("furniture", name, known)
    index = int(model.body_mocapid[model.body(name).id])
    plant.data.mocap_pos[index], plant.data.mocap_quat[index] = position, quat


def get_body_pose(plant: Simulation, name: str) -> np.ndarray:
    """Return the true pose of a body, x y z qw qx qy qz. Shape (7,)."""
    body = plant.model.body(name).id
    return make_pose(plant.data.xpos[body], plant.data.xquat[body])


ROBOT = "robot"
"""Name of all parts of the robot in `Touching.find`."""


class Touching:
    """Finds what touches a body.

    Args:
        plant: The simulation.
        name: The body.
    """

    def __init__(self, plant: Simulation, name: str) -> None:
        self._data = plant.data
        model = plant.model
        body = model.body(name).id
        self._own = np.flatnonzero(model.geom_bodyid == body)
        root = model.body_rootid[model.body(plant.morphology.base_body).id]
        self._names = []
        for geom in range(model.ngeom):
            holder = int(model.geom_bodyid[geom])
            if model.body_rootid[holder] == root:
                self._names.append(ROBOT)
            elif holder == 0:
                self._names.append(model.geom(geom).name)
            else:
                self._names.append(model.body(holder).name)

    def find(self) -> set[str]:
        """Names of furniture, walls, floor and objects in contact; `robot` for the robot."""
        data = self._data
        if data.ncon == 0:
            return set()
        pairs = data.contact.geom
        is_own = np.isin(pairs, self._own)
        met = np.where(is_own[:, :1], pairs[:, 1:], pairs[:, :1])[:, 0]
        hits = met[is_own.any(axis=1) & (data.contact.dist <= 0)]
        return {self._names[int(geom)] for geom in hits}


def compute_speed(plant: Simulation, name: str) -> float:
    """Compute the speed of a body's centre [m/s]."""
    velocity = np.zeros(6)
    body = plant.model.body(name).id
    mujoco.mj_objectVelocity(plant.model, plant.data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
    return float(np.linalg.norm(velocity[3:]))


def compute_tilt(quat: np.ndarray) -> float:
    """Compute the angle between a body's Z axis and the vertical [rad]."""
    _, x, y, _ = quat / np.linalg.norm(quat)
    return float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
