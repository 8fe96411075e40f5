"""Loading of policy tables: the built-in ones, and a user's own."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import get_args

import msgspec

from xop_lerobot.core.command import Mode
from xop_lerobot.core.errors import BadValue, PolicyFileError, UnknownName
from xop_lerobot.low_level import description as d
from xop_lerobot.low_level import onnx_metadata
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.network_policy import MotorSet, NetworkPolicy, Stage
from xop_lerobot.low_level.network_stage import NetworkStage
from xop_lerobot.low_level.networks import LoadedNetwork, ReferenceNetwork, load_network
from xop_lerobot.low_level.policy_file import FileFinder
from xop_lerobot.morphology.morphology import list_robots, make_morphology

logger = logging.getLogger(__name__)

FOLDER = Path(__file__).parent / "policies"
"""Folder of the built-in tables."""
SUFFIX = ".toml"


def list_tables() -> tuple[str, ...]:
    """Names of the built-in tables."""
    return tuple(sorted(file.stem for file in FOLDER.glob(f"*{SUFFIX}")))


def is_table(name: str) -> bool:
    """Whether `name` is the path of a table, or of an ONNX file."""
    return name.endswith((SUFFIX, onnx_metadata.SUFFIX))


def find_robot(name: str) -> str:
    """Name of a table's robot, by name or path of the table.

    Raises:
        UnknownName: If no table has this name.
        PolicyFileError: If there is no such file, or it is malformed.
    """
    return read_table(find_table(name)).robot


def find_table(name: str) -> Path:
    """File of a table, by name or path of the table.

    Raises:
        UnknownName: If no table has this name.
        PolicyFileError: If there is no such file.
    """
    if not is_table(name):
        if name not in list_tables():
            raise UnknownName("policy table", name, list_tables())
        return FOLDER / f"{name}{SUFFIX}"
    file = Path(name).expanduser()
    if not file.is_file():
        raise PolicyFileError(f"policy file '{file}' does not exist")
    return file


def read_table(file: Path) -> d.PolicyTable:
    """Read a table from a TOML file, or from the metadata of an ONNX file.

    Raises:
        PolicyFileError: If it violates the syntax or the schema in `description`; says where.
    """
    if file.suffix == onnx_metadata.SUFFIX:
        return onnx_metadata.make_table(file, _name_robot, read_table(find_table("holosoma")))
    try:
        return msgspec.toml.decode(file.read_bytes(), type=d.PolicyTable)
    except (msgspec.ValidationError, msgspec.DecodeError, UnicodeDecodeError) as error:
        hint = ""
        if ".term" in str(error):
            terms = sorted(_tag(term) for term in (*get_args(d.Seen.__value__), d.Past))
            hint = f". Known terms: {', '.join(terms)}"
        elif "unknown field" in str(error):
            hint = ". docs/use/own_policy.md lists the keys"
        raise PolicyFileError(f"policy table '{file}': {error}{hint}") from error


def _tag(term: type[msgspec.Struct]) -> str:
    return str(term.__struct_config__.tag)


def _name_robot(names: tuple[str, ...]) -> str:
    """Name of the robot that has joints of these names.

    Raises:
        ValueError: If no robot has.
    """
    from xop_lerobot.morphology.body import Body  # noqa: PLC0415  brings MuJoCo

    for robot in list_robots():
        if set(names) <= set(Body(make_morphology(robot)).joint_names):
            return robot
    raise ValueError(f"names joints that no robot has: {', '.join(names)}")


def load_policy(
    name: str, path: str | None = None, network: LoadedNetwork | None = None
) -> NetworkPolicy:
    """Load the policy of a table.

    Args:
        name: Name of a built-in table, or the path of a table.
        path: Its file, or the folder of its files; None to search beside the table, in the cache
            and at the download address.
        network: Network to run instead of all its files, for training.

    Raises:
        UnknownName: If no table has this name.
        PolicyFileError: If the table or a file is missing or malformed.
    """
    file = find_table(name)
    table = read_table(file)
    try:
        return _build(name if name in list_tables() else file.stem, file, table, path, network)
    except BadValue as error:
        raise PolicyFileError(f"policy table '{file}': {error}") from error


def _build(
    name: str, file: Path, table: d.PolicyTable, path: str | None, network: LoadedNetwork | None
) -> NetworkPolicy:
    joints = read_joints(table.robot)
    # A network of both modes is loaded once: `NetworkPolicy` recognises it by identity.
    names = {table.stationary, table.mobile}
    parts = {part: _load_part(part, file, table, path, network) for part in names}
    return NetworkPolicy(name, table, joints, parts[table.stationary], parts[table.mobile])


def _load_part(
    part: str, file: Path, table: d.PolicyTable, path: str | None, own: LoadedNetwork | None
) -> Stage:
    """Load a network of this table, or that of another policy for the same mode."""
    if part in table.networks:
        return _load_stage(part, file, table, path, own)
    other = find_table(part if not is_table(part) else str(file.parent / part))
    theirs = read_table(other)
    if theirs.robot != table.robot:
        raise BadValue(f"{part} is a policy of '{theirs.robot}', this one of '{table.robot}'")
    mode = Mode.STATIONARY if part == table.stationary else Mode.MOBILE
    network = theirs.find_part(mode)
    if network not in theirs.networks:
        raise BadValue(f"{part} has no network of its own for this mode: it names '{network}'")
    return _load_stage(network, other, theirs, path, own)


def _load_stage(
    name: str, file: Path, table: d.PolicyTable, path: str | None, own: LoadedNetwork | None
) -> Stage:
    joints, network = read_joints(table.robot), table.networks[name]
    given = None if path is None else Path(path).expanduser()
    finder = FileFinder(table.title, file.parent, given, len(_list_files(table)))
    _log_licence(table)
    weights_file = "a network in training" if own else finder.find(network.file)
    weights = own or load_network(Path(weights_file))
    reference = None
    if network.reference is not None:
        statistics = network.reference.statistics
        reference = ReferenceNetwork(
            load_network(finder.find(network.reference.file)),
            None if statistics is None else finder.find(statistics),
        )
    try:
        stage = NetworkStage(network, joints, weights, reference)
    except BadValue as error:
        raise BadValue(f"network '{name}' with '{weights_file}': {error}") from error
    return Stage(stage, table, MotorSet.read(table.motors, joints))


def _list_files(table: d.PolicyTable) -> list[d.File]:
    files: list[d.File] = []
    for network in table.networks.values():
        files.append(network.file)
        if network.reference is not None:
            files.append(network.reference.file)
            files += [] if network.reference.statistics is None else [network.reference.statistics]
    return files


_logged: set[str] = set()


def _log_licence(table: d.PolicyTable) -> None:
    """Log the licence, once per policy and process."""
    if table.title in _logged:
        return
    _logged.add(table.title)
    logger.info("%s: licence %s, %s", table.title, table.license, table.source)
    if table.terms:
        logger.warning("%s: %s", table.title, table.terms)
