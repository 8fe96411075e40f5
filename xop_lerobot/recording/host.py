"""Let LeRobot's own commands record `XopDataset`s, with lock-step episodes of exact length.

LeRobot has no command-line option for additional columns, and no hooks for episode boundaries.
While an xop teleoperator exists, this module therefore replaces two names in LeRobot's modules: the
dataset class and, in `lerobot-record`, the loop of one episode, which then runs on another clock.
Robots and teleoperators of other projects are not affected. What is expected of LeRobot is listed
in `xop_lerobot.recording.lerobot_patches`.
"""

from __future__ import annotations

import inspect
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from xop_lerobot.core.errors import BadValue, LinkError
from xop_lerobot.core.shutdown import TermAsInterrupt
from xop_lerobot.recording.lerobot_patches import (
    CONTEXT_DATASET,
    CONTEXT_MODULE,
    POLICY_LOOP,
    RECORD_DATASET,
    RECORD_LOOP,
    RECORD_MODULE,
    Patched,
    fits,
    get_signature,
    get_stock,
    runs,
)
from xop_lerobot.recording.lockstep import count_ticks, without_slow_step_warnings
from xop_lerobot.session import get_session

if TYPE_CHECKING:
    from xop_lerobot.recording.dataset import XopDataset

_HAS_OWN_LOOP = ContextVar("has_own_loop", default=False)


@contextmanager
def own_loop() -> Iterator[None]:
    """Within the block teleoperators do not patch LeRobot: the program has its own loop."""
    token = _HAS_OWN_LOOP.set(True)
    try:
        yield
    finally:
        _HAS_OWN_LOOP.reset(token)


class Host:
    """Patches `lerobot-record` and `lerobot-rollout` to record this project's data.

    Args:
        session: Session to record.
        extra_columns: Whether to record the columns of `xop_lerobot.recording.columns`.
        has_person: Whether a person operates the device and needs time between episodes.
    """

    def __init__(
        self, session: str, *, extra_columns: bool = True, has_person: bool = True
    ) -> None:
        self._session = session
        self._extra_columns = extra_columns
        self._has_person = has_person
        self._patched = Patched()
        self._terminator = TermAsInterrupt()

    def install(self) -> None:
        """Patch the running LeRobot command, if it is one that records.

        Raises:
            LeRobotMisfit: If `lerobot-record` has changed so that episodes would be incomplete.
        """
        records, rolls_out = runs(RECORD_MODULE), runs(CONTEXT_MODULE)
        if _HAS_OWN_LOOP.get() or not (records or rolls_out):
            return
        from xop_lerobot.recording.dataset import XopDataset  # noqa: PLC0415  brings torch

        bound = XopDataset.bind(self._session, extra_columns=self._extra_columns)
        if records and fits(RECORD_DATASET) and fits(RECORD_LOOP):
            self._patched.put(RECORD_DATASET, bound)
            self._patched.put(RECORD_LOOP, self._wrap_loop(get_stock(RECORD_LOOP)))
        if rolls_out and fits(CONTEXT_DATASET):
            self._patched.put(CONTEXT_DATASET, bound)
            if fits(POLICY_LOOP):
                loop = count_in_frames(get_stock(POLICY_LOOP), self._session)
                self._patched.put(POLICY_LOOP, loop)
        if threading.current_thread() is threading.main_thread():
            self._terminator.install()

    def remove(self) -> None:
        """Restore LeRobot's own objects; may be called twice."""
        self._patched.undo()
        self._terminator.remove()

    def _wrap_loop(self, stock: Callable[..., None]) -> Callable[..., None]:
        signature = get_signature(stock)

        def record_loop(*args: Any, **kwargs: Any) -> None:
            """Run LeRobot's `record_loop`; a lock-step episode ends by its number of frames."""
            call = signature.bind(*args, **kwargs).arguments
            if self._is_ours(call["robot"]):
                lockstep = not get_session(self._session).robot.realtime
                dataset: XopDataset | None = call.get("dataset")
                if dataset is None and lockstep and not self._has_person:
                    # Skip the pause: the simulation resets itself and no person needs time.
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
                    # Resets happen inside an observation; do it before the episode's time starts.
                    call["robot"].get_observation()
                if lockstep:
                    with without_slow_step_warnings():
                        stock(**call)
                    return
            stock(**call)

        return record_loop

    def _is_ours(self, robot: object) -> bool:
        try:
            return get_session(self._session).robot.name == getattr(robot, "name", None)
        except LinkError:
            return False


def count_in_frames(stock: Callable[..., None], session: str) -> Callable[..., None]:
    """Make LeRobot's rollout loop end by number of frames for a lock-step robot.

    Args:
        stock: `EpisodicStrategy._policy_loop`.
        session: Session of the robot.
    """
    signature = inspect.signature(stock)

    def policy_loop(*args: Any, **kwargs: Any) -> None:
        """Run LeRobot's loop; the episode's time passes on the robot's clock."""
        from xop_lerobot.recording.dataset import XopDataset  # noqa: PLC0415  brings torch

        call = signature.bind(*args, **kwargs).arguments
        dataset = call["dataset"]
        if not isinstance(dataset, XopDataset) or dataset.session_name != session:
            stock(**call)
            return
        if get_session(session).robot.realtime:
            dataset.begin(call["events"], None)
            stock(**call)
            return
        _check_multiplier(call["self"], dataset.fps)
        dataset.begin(call["events"], count_ticks(call["control_time_s"], dataset.fps))
        call["control_time_s"] = math.inf
        with without_slow_step_warnings():
            stock(**call)

    return policy_loop


def _check_multiplier(strategy: object, fps: int) -> None:
    """Check that each action of the policy is sent once.

    Raises:
        BadValue: If LeRobot interpolates: each action sent advances a lock-step robot by one step.
    """
    multiplier = getattr(getattr(strategy, "_interpolator", None), "multiplier", 1)
    if multiplier != 1:
        raise BadValue(
            f"--interpolation_multiplier must be 1 with a robot in lock-step, got {multiplier}: "
            f"each action that is sent takes 1/{fps} s. Use --robot.clock=realtime for more"
        )
