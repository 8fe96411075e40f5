"""Furniture and objects of a task, added to a model and moved in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.errors import UnknownName
from xop_lerobot.morphology.links import FLOOR_BIT, OBJECT_BIT
from xop_lerobot.transforms import make_pose

if TYPE_CHECKING:
    import mujoco

    from xop_lerobot.plant.simulation import Simulation

PARKING = (30.0, 30.0)
"""Where everything stands until it is placed, far from any robot [m]."""

SLIDING, TORSION, ROLLING = 0.6, 0.005, 0.0001
"""Friction of furniture: lacquered wood; MuJoCo's defaults in torsion and rolling."""


def add_furniture_body(spec: mujoco.MjSpec, name: str, index: int = 0) -> mujoco.MjsBody:
    """Add a body that stands still where it is placed; `index` keeps parked ones apart."""
    return spec.worldbody.add_body(
        name=name, mocap=True, pos=(PARKING[0] + 3 * index, PARKING[1], 0)
    )


def add_object_body(
    spec: mujoco.MjSpec, name: str, height: float, index: int = 0
) -> mujoco.MjsBody:
    """Add a body that moves freely, parked on the floor.

    Args:
        spec: The model.
        name: Its name.
        height: Of its frame over the floor where it is parked [m].
        index: Keeps parked objects apart.
    """
    body = spec.worldbody.add_body(name=name, pos=(PARKING[0] + 3 * index, PARKING[1] + 6, height))
    body.add_freejoint(name=f"{name}_joint")
    return body


def add_solid(  # noqa: PLR0913 a geom has as many properties
    body: mujoco.MjsBody,
    name: str,
    kind: str,
    size: tuple[float, ...],
    pos: tuple[float, ...],
    colour: tuple[float, ...],
    friction: tuple[float, float, float] = (SLIDING, TORSION, ROLLING),
) -> mujoco.MjsGeom:
    """Add a part of furniture, which meets robots and objects, but no floor and no furniture.

    Args:
        body: The furniture.
        name: Name of the geom.
        kind: ``"box"``, ``"cylinder"`` or another primitive.
        size: As MuJoCo takes it [m].
        pos: Centre in the body [m].
        colour: Red, green, blue, opacity.
        friction: Sliding, torsional [m], rolling [m].
    """
    import mujoco  # noqa: PLC0415

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
    """Add something that is seen and touches nothing."""
    geom = add_solid(body, name, kind, size, pos, colour)
    geom.contype = geom.conaffinity = 0
    geom.mass = 0
    return geom


OBJECT_CONTACT = {"contype": OBJECT_BIT, "conaffinity": FLOOR_BIT | OBJECT_BIT}
"""Collision bits of an object that moves: it meets the floor, robots and furniture."""


def place(plant: Simulation, name: str, position: np.ndarray, quat: np.ndarray) -> None:
    """Put furniture somewhere; the caller brings the positions up to date with `settle`.

    Args:
        plant: The simulation.
        name: Name of the furniture.
        position: Where its frame goes [m]. Shape (3,).
        quat: How it is turned, wxyz. Shape (4,).

    Raises:
        UnknownName: If there is no such furniture; lists what there is.
    """
    model = plant.model
    known = [model.body(i).name for i in range(model.nbody) if model.body_mocapid[i] >= 0]
    if name not in known:
        raise UnknownName("furniture", name, known)
    index = int(model.body_mocapid[model.body(name).id])
    plant.data.mocap_pos[index], plant.data.mocap_quat[index] = position, quat


def get_body_pose(plant: Simulation, name: str) -> np.ndarray:
    """True pose of a body, x y z qw qx qy qz. Shape (7,)."""
    body = plant.model.body(name).id
    return make_pose(plant.data.xpos[body], plant.data.xquat[body])
