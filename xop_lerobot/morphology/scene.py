"""Scenes: floor, light and objects around a robot, and models of a robot in a scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from xop_lerobot.core.registry import Registry
from xop_lerobot.morphology.links import FLOOR_BIT, OBJECT_BIT
from xop_lerobot.morphology.morphology import ModelKind, Morphology
from xop_lerobot.morphology.sensing import add_sensing

if TYPE_CHECKING:
    import mujoco

OFFSCREEN = (640, 480)
"""Largest image that can be rendered, width and height [px]."""

SCENES: Registry[Callable[[mujoco.MjSpec], None]] = Registry("scene")
"""Functions by name that add a scene's objects to a model with a robot and a floor."""


def build_scene_spec(
    morphology: Morphology, kind: ModelKind, scene: str = "empty"
) -> mujoco.MjSpec:
    """Build a robot in a scene, as an editable model.

    The robot comes first in qpos, qvel and among the actuators; the scene's objects follow.
    The planning model has only the floor, whatever the scene, and the sensors of `Sensing`.

    Args:
        morphology: The robot.
        kind: ``"full"`` or ``"planning"``.
        scene: Name of the scene.

    Raises:
        UnknownName: Listing the known scenes.
    """
    import mujoco  # noqa: PLC0415

    add_objects = SCENES[scene]
    spec = morphology.build_spec(kind)
    add_floor(spec, seen=kind == "full")
    if kind == "full":
        # With MuJoCo's default friction cone, standing feet creep by a millimetre per second. The
        # elliptic cone holds them, but costs two to four times as much, so the short predictions
        # of the planning model do without.
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 100
        add_sky(spec)
        add_objects(spec)
    else:
        add_sensing(spec, morphology)
    return spec


def build_model(morphology: Morphology, kind: ModelKind, scene: str = "empty") -> mujoco.MjModel:
    """Build and compile a robot in a scene; see `build_scene_spec`.

    Raises:
        UnknownName: Listing the known scenes.
    """
    return build_scene_spec(morphology, kind, scene).compile()


def add_floor(spec: mujoco.MjSpec, *, seen: bool) -> None:
    """Add the ground plane z = 0: infinite for contacts, displayed 30 m wide."""
    import mujoco  # noqa: PLC0415

    floor = spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=(15, 15, 0.05),
        contype=FLOOR_BIT,
        conaffinity=FLOOR_BIT,
    )
    if seen:
        spec.add_texture(
            name="floor",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            width=64,
            height=64,
            rgb1=(0.62, 0.64, 0.66),
            rgb2=(0.52, 0.54, 0.57),
        )
        material = spec.add_material(
            name="floor", texrepeat=(1, 1), texuniform=True, reflectance=0, specular=0
        )
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
        floor.material = "floor"


def add_sky(spec: mujoco.MjSpec) -> None:
    """Add a pale sky and lights without shadows, with settings for fast software rendering."""
    import mujoco  # noqa: PLC0415

    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=32,
        height=192,
        rgb1=(0.86, 0.90, 0.95),
        rgb2=(0.70, 0.76, 0.83),
    )
    for direction, brightness in (((0.3, 0.4, -1), 0.5), ((-0.6, -0.5, -0.6), 0.3)):
        spec.worldbody.add_light(
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            dir=np.divide(direction, np.linalg.norm(direction)),
            diffuse=(brightness,) * 3,
            specular=(0.15,) * 3,
            castshadow=False,
        )
    spec.visual.headlight.ambient = (0.45,) * 3
    spec.visual.headlight.diffuse = (0.22,) * 3
    spec.visual.headlight.specular = (0,) * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = OFFSCREEN
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0
    # Near and far planes are multiples of the extent, which would otherwise grow with the scene.
    spec.stat.extent = 2
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 30
    # Coarser spheres and cylinders: half the triangles, the same image at 320 × 240.
    spec.visual.quality.numslices = 20
    spec.visual.quality.numstacks = 10


@SCENES.register("empty")
def add_nothing(spec: mujoco.MjSpec) -> None:
    """Add nothing: the robot stands on an infinite floor."""


@SCENES.register("room")
def add_room(spec: mujoco.MjSpec) -> None:
    """Add four walls of a room of 8 m by 8 m, 2.5 m high."""
    add_walls(spec, 4.0)


@SCENES.register("small_room")
def add_small_room(spec: mujoco.MjSpec) -> None:
    """Add four walls of a room of 4.4 m by 4.4 m, 2.5 m high, for tasks in a confined space."""
    add_walls(spec, 2.2)


def add_walls(spec: mujoco.MjSpec, half: float) -> None:
    """Add the walls of a square room about the origin, `half` [m] from it, 2.5 m high."""
    middle, outer = half + 0.05, half + 0.1
    walls = (
        ("front", (middle, 0), (0.05, outer), (0.85, 0.83, 0.78, 1)),
        ("back", (-middle, 0), (0.05, outer), (0.80, 0.82, 0.85, 1)),
        ("left", (0, middle), (half, 0.05), (0.78, 0.84, 0.80, 1)),
        ("right", (0, -middle), (half, 0.05), (0.86, 0.80, 0.78, 1)),
    )
    for name, (x, y), (length, width), colour in walls:
        add_block(spec, f"wall_{name}", (x, y, 1.25), (length, width, 1.25), colour)


@SCENES.register("tabletop")
def add_tabletop(spec: mujoco.MjSpec) -> None:
    """Add a table in front of the robot, its top at 0.72 m, and a movable box of 12 cm."""
    wood, steel = (0.72, 0.55, 0.38, 1), (0.35, 0.36, 0.38, 1)
    add_block(spec, "table_top", (0.75, 0, 0.70), (0.25, 0.5, 0.02), wood)
    for i, (x, y) in enumerate(((0.54, 0.45), (0.54, -0.45), (0.96, 0.45), (0.96, -0.45))):
        add_block(spec, f"table_leg_{i}", (x, y, 0.34), (0.02, 0.02, 0.34), steel)
    box = spec.worldbody.add_body(name="box", pos=(0.68, 0, 0.781))
    box.add_freejoint(name="box_joint")
    geom = add_block(box, "box", (0, 0, 0), (0.06, 0.06, 0.06), (0.85, 0.33, 0.20, 1))
    geom.mass, geom.friction = 0.3, (0.8, 0.01, 0.001)


def add_block(
    parent: mujoco.MjSpec | mujoco.MjsBody,
    name: str,
    pos: tuple[float, ...],
    half: tuple[float, ...],
    colour: tuple[float, ...],
) -> mujoco.MjsGeom:
    """Add a box that collides with robots, objects and the floor.

    Args:
        parent: A model, for a fixed box, or a body.
        name: Name of its geom.
        pos: Centre [m].
        half: Half sizes [m].
        colour: Red, green, blue, opacity.
    """
    import mujoco  # noqa: PLC0415

    body = parent.worldbody if isinstance(parent, mujoco.MjSpec) else parent
    bits = FLOOR_BIT | OBJECT_BIT
    return body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=pos,
        size=half,
        rgba=colour,
        contype=bits,
        conaffinity=bits,
    )
