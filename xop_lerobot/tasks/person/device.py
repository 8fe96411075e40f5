"""Device of a simulated person, who watches the robot and performs its task."""

from __future__ import annotations

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.operator.device import Device
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.display import View
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.tasks.person.intentions import INTENTIONS, PREPARATIONS
from xop_lerobot.tasks.person.mind import Doing, GaveUp, Mind

LINGER = 1.5
"""Time the person stays after the task is done or given up [s]."""


class SimulatedDevice(Device):
    """A person with the parameters of `Person`; equal seeds give equal persons.

    The person starts the displayed task when engaged. All it knows is what `see` has shown it.

    Args:
        config: Device settings: `seed`, `noise` and `start_mode`.
    """

    self_engaging = True

    def __init__(self, config: DeviceConfig) -> None:
        self.config = config
        self.start_mode = config.start_mode
        self._task: str | None = None
        self._attempt = 0
        self._begin()

    def _begin(self) -> None:
        self.mind = Mind(self.config.seed, self.config.noise, self._attempt)
        self._doing: Doing | None = None
        self._started_at: float | None = None
        self._over_at: float | None = None

    def begin_episode(self, index: int) -> None:
        """Become the person of episode `index`, independent of earlier episodes."""
        self._attempt = index
        self._begin()

    def start(self, time: float) -> None:
        """Start the task at `time` [s] of the robot's clock; a second start is a new attempt."""
        if self._started_at is not None:
            self._attempt += 1
            self._begin()
        self._started_at = time

    def see(self, view: View) -> None:
        """Receive what the headset displays.

        Raises:
            UnknownName: If the task has no intention; lists those that have.
        """
        if view.task not in INTENTIONS:
            raise UnknownName("task of the simulated operator", view.task, INTENTIONS)
        self._task = view.task
        self.mind.see(view)
        if self._started_at is None and view.task in PREPARATIONS:
            PREPARATIONS[view.task](self.mind)

    def read(self, time: float) -> OperatorFrame:
        """Advance the person to `time` [s] of the robot's clock and return its frame.

        Raises:
            BadValue: If the person is engaged but has been shown no task.
        """
        if self._started_at is None:
            return self.mind.make_frame(0.0)
        clock = max(time - self._started_at, 0.0)
        if clock <= self.mind.time and clock > 0:
            return self.mind.make_frame(clock)
        if self._task is None:
            raise BadValue(
                "device 'simulated' sees nothing to do: it needs a robot with a task, "
                "--robot.task=NAME"
            )
        if self._doing is None:
            self._doing = self._act(self._task)
        self.mind.body.advance(clock)
        self.mind.look(time)
        if self._over_at is None and next(self._doing, self) is self:
            self._over_at = clock
        return self.mind.make_frame(clock)

    def is_finished(self, time: float) -> bool:
        """Whether the person has finished or given up, and `LINGER` has passed since."""
        del time
        return self._over_at is not None and self.mind.time >= self._over_at + LINGER

    def _act(self, task: str) -> Doing:
        mind = self.mind
        doing = INTENTIONS[task](mind)
        try:
            while True:
                if not mind.eyes.is_blind and mind.eyes.fallen:
                    raise GaveUp("the robot has fallen")
                if next(doing, doing) is doing:
                    mind.note("done")
                    return
                yield
        except GaveUp as reason:
            mind.note(f"gave up: {reason}")
