"""Policy tables from the metadata of ONNX files, as exported by mjlab and holosoma.

mjlab stores joints, gains, default posture, action scale, and name, scale, clip and history of
every observation term; such a file needs no table. holosoma stores joints, gains and command
ranges; the layout of its observation is that of the built-in table ``holosoma``.

Neither states who controls the arms. Here they follow their targets, as teleoperation needs it, and
the network observes their measured angles.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from xop_lerobot.core.errors import PolicyFileError
from xop_lerobot.low_level import description as d

SUFFIX = ".onnx"

VELOCITIES = ("vx", "vy", "yaw_rate")
"""Command entries of both exporters, in order."""


def read_metadata(file: Path) -> dict[str, str]:
    """Read the metadata of an ONNX file.

    Raises:
        PolicyFileError: If it is missing or not an ONNX file.
    """
    import onnx  # noqa: PLC0415
    from google.protobuf.message import DecodeError  # noqa: PLC0415

    if not file.is_file():
        raise PolicyFileError(f"policy file '{file}' does not exist")
    try:
        model = onnx.load(str(file))
    except DecodeError as error:
        raise PolicyFileError(f"policy file '{file}' is not an ONNX model") from error
    return {each.key: each.value for each in model.metadata_props}


def make_table(
    file: Path, find_robot: Callable[[tuple[str, ...]], str], holosoma: d.PolicyTable
) -> d.PolicyTable:
    """Make the policy table of an ONNX file with metadata.

    Args:
        file: The file.
        find_robot: Returns the name of the robot that has the given joints.
        holosoma: Table with holosoma's observation layout.

    Raises:
        PolicyFileError: If the metadata is incomplete or not supported.
    """
    metadata = read_metadata(file)
    try:
        if "observation_names" in metadata:
            return _read_mjlab(file, metadata, find_robot)
        if {"dof_names", "kp", "kd"} <= metadata.keys():
            return _read_holosoma(file, metadata, find_robot, holosoma)
    except (KeyError, ValueError) as error:
        raise PolicyFileError(f"policy file '{file}': metadata {error}") from error
    raise PolicyFileError(
        f"policy file '{file}' does not describe itself: it holds neither mjlab's "
        "observation_names nor holosoma's dof_names, kp and kd. Describe it by a table, see "
        "docs/use/own_policy.md"
    )


def _read_mjlab(
    file: Path, metadata: Mapping[str, str], find_robot: Callable[[tuple[str, ...]], str]
) -> d.PolicyTable:
    joints = tuple(_split(metadata["joint_names"]))

    def by_joint(key: str) -> dict[str, float]:
        numbers = [float(word) for word in _split(metadata[key])]
        if len(numbers) == 1:
            numbers *= len(joints)
        if len(numbers) != len(joints):
            raise ValueError(f"'{key}' has {len(numbers)} numbers for {len(joints)} joints")
        return dict(zip(joints, numbers, strict=True))

    names = _split(metadata["observation_names"])
    scales = _split(metadata.get("observation_terms_scale", ",".join("1" for _ in names)))
    clips = _split(metadata.get("observation_terms_clip", ",".join("-inf;inf" for _ in names)))
    frames = _split(metadata.get("observation_terms_history_length", ",".join("0" for _ in names)))
    terms = []
    for name, scale, clip, history in zip(names, scales, clips, frames, strict=True):
        if [abs(float(bound)) for bound in clip.split(";")] != [float("inf")] * 2:
            raise ValueError(f"'observation_terms_clip' of {name} is {clip}, expected -inf;inf")
        factors = tuple(float(factor) for factor in scale.split(";"))
        # A history length of 0 means the present frame alone, as 1 does.
        terms.append(_make_term(name, joints, factors, max(int(float(history)), 1)))
    network = d.Network(
        file=d.File(file.name),
        sees=tuple(terms),
        action=d.Action(joints=joints, scale=by_joint("action_scale"), discard=("arms",)),
        default=by_joint("default_joint_pos"),
        begins="first frame",
    )
    return d.PolicyTable(
        title=file.stem,
        robot=find_robot(joints),
        license="unknown",
        source=metadata.get("run_path", str(file)),
        stationary="network",
        mobile="network",
        networks={"network": network},
        motors=d.Motors(by_joint("joint_stiffness"), by_joint("joint_damping")),
        # No velocity in stationary mode, not even for a weight shift.
        ranges={"stationary": dict.fromkeys(VELOCITIES, (0.0, 0.0))},
    )


def _make_term(name: str, joints: tuple[str, ...], scale: tuple[float, ...], frames: int) -> d.Seen:
    factor = scale[0] if len(scale) == 1 else scale
    plain: dict[str, type[d.Term]] = {
        "base_lin_vel": d.LinearVelocity,
        "base_ang_vel": d.AngularVelocity,
        "projected_gravity": d.Gravity,
        "actions": d.Actions,
    }
    if name in plain:
        return plain[name](scale=factor, frames=frames)  # pyright: ignore[reportReturnType]
    if name == "joint_pos":
        return d.JointPositions(scale=factor, frames=frames, joints=joints)
    if name == "joint_vel":
        return d.JointVelocities(scale=factor, frames=frames, joints=joints)
    if name == "command":
        return d.Commands(scale=factor, frames=frames, names=VELOCITIES, gated=True)
    known = sorted([*plain, "joint_pos", "joint_vel", "command"])
    raise ValueError(f"'observation_names' has {name!r}. Known: {', '.join(known)}")


def _read_holosoma(
    file: Path,
    metadata: Mapping[str, str],
    find_robot: Callable[[tuple[str, ...]], str],
    layout: d.PolicyTable,
) -> d.PolicyTable:
    joints, stiffness, damping = (json.loads(metadata[key]) for key in ("dof_names", "kp", "kd"))
    networks = {
        name: msgspec.structs.replace(network, file=d.File(file.name))
        for name, network in layout.networks.items()
    }
    return msgspec.structs.replace(
        layout,
        title=file.stem,
        robot=find_robot(tuple(joints)),
        source=str(file),
        networks=networks,
        motors=d.Motors(
            dict(zip(joints, stiffness, strict=True)),
            dict(zip(joints, damping, strict=True)),
            layout.motors.torque,
        ),
    )


def _split(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]
