"""Let LeRobot's own commands record `XopDataset`s, and hold lock-step episodes to their length.

LeRobot offers no way to add columns, or a hook for the episodes' boundaries, from its command
line. While an xop teleoperator exists, this module therefore puts two names of LeRobot's modules
in the place of LeRobot's own: the dataset class, and in `lerobot-record` the loop of one episode,
which is LeRobot's with another clock. Robots and teleoperators of others are passed through
unchanged. If LeRobot's signatures have moved, nothing is replaced, and a warning says so.
"""

from __future__ import annotations

import inspect
import logging
import math
import sys
import threading
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.errors import LinkError
from xop_lerobot.core.shutdown import TermAsInterrupt
from xop_lerobot.recording.lockstep import count_ticks, without_slowness
from xop_lerobot.session import get_session

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from xop_lerobot.recording.dataset import XopDataset

logger = logging.getLogger(__name__)

RECORD_MODULE = "lerobot.scripts.lerobot_record"
ROLLOUT_MODULE = "lerobot.rollout.context"

_DATASET_SIGNATURES = {
    "create": ("repo_id", "fps", "features", "root"),
    "resume": ("repo_id", "root"),
    "add_frame": ("self", "frame"),
    "save_episode": ("self", "episode_data", "parallel_encoding"),
    "clear_episode_buffer": ("self", "delete_images"),
    "finalize": ("self",),
}
"""First parameters of the dataset's methods that `XopDataset` overrides."""
_META_SIGNATURES = {
    "save_episode": (
        "self",
        "episode_index",
        "episode_length",
        "episode_tasks",
        "episode_stats",
        "episode_metadata",
    ),
}
_LOOP_PARAMETERS = ("robot", "events", "dataset", "teleop", "control_time_s")
"""Parameters of `record_loop` that the replacement reads or changes."""


class Host:
    """LeRobot's record and rollout modules, as far as this project changes them.

    Args:
        session: Session whose episodes are recorded.
        extra_columns: Whether to record the columns of `xop_lerobot.recording.columns`.
        has_person: Whether a person holds the device, who needs time between the episodes.
    """

    def __init__(
        self, session: str, *, extra_columns: bool = True, has_person: bool = True
    ) -> None:
        self._session = session
        self._extra_columns = extra_columns
        self._has_person = has_person
        self._stock: list[tuple[ModuleType | type, str, object, object]] = []
        self._terminator = TermAsInterrupt()

    def install(self) -> None:
        """Replace the names in those of LeRobot's modules that are loaded."""
        modules = [module for name in (RECORD_MODULE, ROLLOUT_MODULE) if (module := find(name))]
        if not modules:
            return
        fault = find_fault(modules)
        if fault:
            logger.warning(
                "LeRobot has changed (%s), so episodes are recorded WITHOUT the operator's "
                "columns, and a lock-step episode ends by the wall clock. Use xop-record, or the "
                "LeRobot version that this release was made for.",
                fault,
            )
            return
        from xop_lerobot.recording.dataset import XopDataset  # noqa: PLC0415  brings torch

        bound = XopDataset.bind(self._session, extra_columns=self._extra_columns)
        for module in modules:
            self._replace(module, "LeRobotDataset", bound)
            if hasattr(module, "record_loop"):
                loop = module.record_loop
                stock = getattr(loop, "xop_stock", loop)
                self._replace(module, "record_loop", self._wrap_loop(stock))
        self._hold_policies_to_length()
        if threading.current_thread() is threading.main_thread():
            self._terminator.install()

    def _hold_policies_to_length(self) -> None:
        """Let `lerobot-rollout`, if it runs, count frames too, where its loop is as expected."""
        from xop_lerobot.recording import rollout_loop  # noqa: PLC0415  brings torch

        if find(ROLLOUT_MODULE) is None:
            return
        strategy, fault = rollout_loop.find_strategy()
        if strategy is None:
            logger.warning(
                "LeRobot has changed (%s), so a lock-step episode of lerobot-rollout ends by the "
                "wall clock. Use the LeRobot version that this release was made for.",
                fault,
            )
            return
        loop = getattr(strategy, rollout_loop.LOOP)
        stock = getattr(loop, "xop_stock", loop)
        ours = rollout_loop.count_in_frames(stock, self._session)
        self._replace(strategy, rollout_loop.LOOP, ours)

    def remove(self) -> None:
        """Put LeRobot's own names back; may be called twice."""
        for module, name, stock, ours in reversed(self._stock):
            # Another host may have come after this one.
            if getattr(module, name) is ours:
                setattr(module, name, stock)
        self._stock.clear()
        self._terminator.remove()

    def _replace(self, module: ModuleType | type, name: str, ours: Any) -> None:
        current = getattr(module, name)
        stock = getattr(current, "xop_stock", current)
        ours.xop_stock = stock
        self._stock.append((module, name, stock, ours))
        setattr(module, name, ours)

    def _wrap_loop(self, stock: Callable[..., None]) -> Callable[..., None]:
        signature = get_loop_signature(stock)

        def record_loop(*args: Any, **kwargs: Any) -> None:
            """Run LeRobot's `record_loop`; a lock-step episode ends by its number of frames."""
            call = signature.bind(*args, **kwargs).arguments
            if self._is_ours(call["robot"]):
                lockstep = not get_session(self._session).robot.realtime
                dataset: XopDataset | None = call.get("dataset")
                if dataset is None and lockstep and not self._has_person:
                    # The robot resets itself, and nobody has to tidy a simulation.
                    return
                recorder = get_session(self._session).recorder
                if dataset is None and recorder is not None:
                    recorder.pause(call["events"])
                if dataset is not None and lockstep:
                    ticks = count_ticks(call["control_time_s"], dataset.fps)
                    dataset.begin(call["events"], ticks)
                    call["control_time_s"] = math.inf
                elif dataset is not None:
                    dataset.begin(call["events"], None)
                    # The robot starts over in an observation: not on the episode's time.
                    call["robot"].get_observation()
                if lockstep:
                    with without_slowness():
                        stock(**call)
                    return
            stock(**call)

        return record_loop

    def _is_ours(self, robot: object) -> bool:
        try:
            return get_session(self._session).robot.name == getattr(robot, "name", None)
        except LinkError:
            return False


def find(name: str) -> ModuleType | None:
    """Return LeRobot's module `name` if it is loaded, also when it is the program itself."""
    main = sys.modules.get("__main__")
    if main is not None and getattr(getattr(main, "__spec__", None), "name", None) == name:
        return main
    return sys.modules.get(name)


def get_loop_signature(loop: Callable[..., None]) -> inspect.Signature:
    """Return the signature of LeRobot's loop, which a decorator hides in a closure."""
    inner = getattr(loop, "xop_stock", loop)
    inner = inspect.getclosurevars(inner).nonlocals.get("func", inner)
    return inspect.signature(inner)


def find_fault(modules: list[ModuleType]) -> str:
    """Say what in LeRobot is not as this module expects it; empty if all is."""
    for module in modules:
        dataset: type[LeRobotDataset] | None = getattr(module, "LeRobotDataset", None)
        if dataset is None:
            return f"{module.__name__} has no LeRobotDataset"
        fault = _compare(dataset, _DATASET_SIGNATURES)
        if not fault and find(RECORD_MODULE) is module:
            fault = _find_loop_fault(module)
        if fault:
            return fault
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # noqa: PLC0415

    return _compare(LeRobotDatasetMetadata, _META_SIGNATURES)


def _compare(owner: type, expected: dict[str, tuple[str, ...]]) -> str:
    for name, parameters in expected.items():
        method = getattr(owner, name, None)
        if method is None:
            return f"{owner.__name__} has no {name}()"
        actual = tuple(inspect.signature(method).parameters)
        if actual[: len(parameters)] != parameters:
            return f"{owner.__name__}.{name}() takes {', '.join(actual)}"
    return ""


def _find_loop_fault(module: ModuleType) -> str:
    loop = getattr(module, "record_loop", None)
    if loop is None:
        return f"{module.__name__} has no record_loop()"
    actual = get_loop_signature(loop).parameters
    missing = [name for name in _LOOP_PARAMETERS if name not in actual]
    return f"record_loop() has no parameter {', '.join(missing)}" if missing else ""
