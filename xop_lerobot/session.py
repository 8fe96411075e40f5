"""Session: where the robot and the teleoperator of one process exchange data.

LeRobot's loops pass the teleoperator no observation, and connect the two devices in either order.
So the robot publishes its description here (`announce`) and, in every `get_observation`, starts a
`Tick` (`begin_tick`). Teleoperator and robot add their results to that tick (`put`), and the
recorder reads it. Publishing replaces one immutable value, so readers need no lock.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, field
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from xop_lerobot.core.errors import LinkError
from xop_lerobot.core.state import Goal, RobotState
from xop_lerobot.morphology.morphology import list_robot_types
from xop_lerobot.operator.display import Cue, Progress, RecordingRequest, View
from xop_lerobot.operator.frame import OperatorFrame

if TYPE_CHECKING:
    from xop_lerobot.morphology.morphology import Morphology
    from xop_lerobot.retarget.obstacles import Obstacle
    from xop_lerobot.retarget.online import AppliedChange


@dataclass(frozen=True)
class RobotInfo:
    """Description of a robot for its teleoperator.

    Attributes:
        name: LeRobot's robot type, ``"xop_g1"``.
        morphology: The robot's morphology.
        low_level: Name of its low-level policy.
        low_level_path: File of that policy, None for its default.
        scene: Name of its scene.
        fps: Rate of the control loop [Hz].
        seed: Seed of its session.
        realtime: Whether its clock is the wall clock.
        has_truth: Whether its states contain the true position besides the measured one, as only a
            simulation's can.
        cameras: Image height, width and channels by camera name.
    """

    name: str
    morphology: Morphology
    low_level: str
    low_level_path: str | None
    scene: str
    fps: int
    seed: int
    realtime: bool = False
    has_truth: bool = True
    cameras: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskStatus:
    """Status of an episode's task, judged by the physics alone.

    Attributes:
        success: Whether the task is accomplished.
        done: Whether the episode is over, successful or not.
        failure: Why the episode failed; empty while it has not.
        picked_up: Whether the object was held up for the required time.
        figures: Further metrics of the episode by name, as plain values for JSON.
        collisions: Pairs of robot part and touched wall or furniture so far, except hands on what
            the task has them handle.
    """

    success: bool
    done: bool
    failure: str = ""
    picked_up: bool = False
    figures: Mapping[str, float] = field(default_factory=dict)
    collisions: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Tick:
    """One control step, from the measurement to its outcome; each stage adds its fields.

    1. *Observed* by the robot in `get_observation`: `state`, `view`, `pictures`,
       `proprioception`, and `outcome` as it is before the action.
    2. *Decided* by the teleoperator in `get_action`: `frame` to `changes`. These stay at their
       defaults where something else drives the robot, such as a policy.
    3. *Executed* by the robot in `send_action`: `executed`, and `outcome` after the action.
    4. Read by the recorder in `add_frame`.

    A stage that is repeated within a tick overwrites its fields.

    Attributes:
        state: Measured robot state at the start of the tick.
        view: What a person could see of the robot and its task, None without a task.
        pictures: Camera images by name. Shapes (height, width, 3), uint8.
        proprioception: The robot's observation without images, by key.
        frame: The operator's frame, None before the first.
        goal: The goal, None while not engaged.
        command: The retargeter's command a* before limits; None until decided. Shape (k,).
        cost: Plan cost by term.
        health: Health metrics of the plan by name (solve time, age, effective samples, …).
        finished: Whether the device has played to its end.
        estimate: Position that the tick was planned from, if the measured one was first made
            consistent with the ground contacts; None otherwise. Shape (nq,).
        settings: Settings of the tick (preset, weights, targets, mode, …).
        changes: Changes of settings that took effect at its start.
        executed: Action after limits, by key; None until an action is sent.
        outcome: Status of the task, None without a task.
    """

    state: RobotState
    view: View | None = None
    pictures: Mapping[str, np.ndarray] = field(default_factory=dict)
    proprioception: Mapping[str, float] = field(default_factory=dict)

    frame: OperatorFrame | None = None
    goal: Goal | None = None
    command: np.ndarray | None = None
    cost: Mapping[str, float] = field(default_factory=dict)
    health: Mapping[str, float] = field(default_factory=dict)
    finished: bool = False
    estimate: np.ndarray | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    changes: tuple[AppliedChange, ...] = ()

    executed: Mapping[str, float] | None = None
    outcome: TaskStatus | None = None

    @property
    def engaged(self) -> bool:
        """Whether an operator is engaged."""
        return self.goal is not None


class Recorder(Protocol):
    """Interface of the recorder of a session."""

    def grant(self, request: RecordingRequest) -> tuple[Cue, str]:
        """Fulfil the operator's request; return the notice for the operator."""
        ...

    def pause(self, events: MutableMapping[str, bool]) -> None:
        """Start the pause after an episode, with the events of its loop."""
        ...

    def forget_presses(self) -> None:
        """Discard key presses from before the robot was ready for the episode."""
        ...


class Session:
    """Shared state of one robot and one teleoperator.

    Attributes:
        name: The session's name.
        tick: Current tick, None before the robot's first observation and after a reset.
        obstacles: Walls and furniture of the episode, None if no task places any.
        episode: Index of the episode being recorded; seeds the robot's episode.
        reset_count: Number of robot resets; a change tells the teleoperator to align again.
        progress: Progress of the recording, None without one.
        recorder: The recorder, None without one.
        configs: Resolved configuration of each part (`robot`, `teleop`), stored with a dataset.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = Lock()
        self._robots: list[RobotInfo] = []
        self._reset_asked = False
        self.tick: Tick | None = None
        self.obstacles: tuple[Obstacle, ...] | None = None
        self.episode = 0
        self.reset_count = 0
        self.progress: Progress | None = None
        self.recorder: Recorder | None = None
        self.configs: dict[str, Any] = {}

    def announce(self, info: RobotInfo) -> None:
        """Add the robot `info` to the session."""
        with self._lock:
            if not any(known is info for known in self._robots):
                self._robots.append(info)

    def withdraw(self, info: RobotInfo) -> None:
        """Remove the robot `info` from the session; unknown ones are ignored."""
        with self._lock:
            self._robots = [known for known in self._robots if known is not info]
            if not self._robots:
                self._forget()
                self.episode, self._reset_asked = 0, False
                self.progress = self.recorder = None

    def begin_episode(self, index: int) -> None:
        """Request a reset of the robot for episode `index`, in its next `get_observation`."""
        self.episode = index
        self._reset_asked = True

    def take_reset(self) -> bool:
        """Whether a reset was requested since the last call; called by the robot only."""
        asked, self._reset_asked = self._reset_asked, False
        return asked

    def confirm_reset(self) -> None:
        """Count a finished reset of the robot, and discard the state from before."""
        self._forget()
        self.reset_count += 1
        if self.recorder is not None:
            self.recorder.forget_presses()

    def begin_tick(self, tick: Tick) -> None:
        """Publish an observation as the start of a tick; called by the robot only."""
        with self._lock:
            self.tick = tick

    def put(self, tick: Tick) -> None:
        """Publish `tick` with one more stage.

        A tick that is no longer the current one, because the robot was observed or reset meanwhile,
        is ignored: its stages must not mix with those of another tick.
        """
        with self._lock:
            if self.tick is not None and self.tick.state is tick.state:
                self.tick = tick

    def ask(self, request: RecordingRequest) -> tuple[Cue, str]:
        """Pass `request` to the recorder; return the notice for the operator."""
        if self.recorder is None:
            return Cue.REFUSED, "Nothing is recorded."
        return self.recorder.grant(request)

    def _forget(self) -> None:
        self.tick = self.obstacles = None

    @property
    def robot(self) -> RobotInfo:
        """The session's only robot.

        Raises:
            LinkError: If there is none, or more than one.
        """
        if not self._robots:
            raise LinkError(
                f"no xop robot in session '{self.name}'. Use --robot.type={list_robot_types()} "
                f"with --robot.session={self.name}, the same as --teleop.session."
            )
        if len(self._robots) > 1:
            names = ", ".join(info.name for info in self._robots)
            raise LinkError(
                f"{len(self._robots)} robots in session '{self.name}' ({names}); a teleoperator "
                "drives one. Give each pair its own --robot.session and --teleop.session."
            )
        return self._robots[0]


_SESSIONS: dict[str, Session] = {}
_SESSIONS_LOCK = Lock()


def get_session(name: str = "default") -> Session:
    """Return the session `name`, created on first use."""
    with _SESSIONS_LOCK:
        return _SESSIONS.setdefault(name, Session(name))
