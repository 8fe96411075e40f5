"""The simulated person as skills see it: perception, body, belief and random numbers.

Skills and intentions are generators over control ticks (`Doing`); each `next` advances one tick.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.core.transforms import (
    compute_heading,
    make_pose,
    pose_multiply,
    quat_from_yaw,
    quat_multiply,
    quat_rotate,
)
from xop_lerobot.operator.display import View
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.tasks.person.belief import Belief
from xop_lerobot.tasks.person.body import SIDES, WRIST_TO_PALM, Body
from xop_lerobot.tasks.person.perception import Perception
from xop_lerobot.tasks.person.person import Person, draw_person

type Doing = Iterator[None]
"""An activity of the person: a generator that advances by one control tick per `next`."""


class GaveUp(Exception):
    """Raised when the person knows no further way to perform the task; the text is the reason."""


class Mind:
    """Perception, body, belief and random generator of one person, on which skills act.

    Args:
        seed: Seed of the person and of all its random numbers.
        noise: Scale of sway and tremor [1].
        attempt: Index of the attempt: the same person with other random numbers.
    """

    def __init__(self, seed: int, noise: float = 1.0, attempt: int = 0) -> None:
        character = np.random.SeedSequence([seed, 2])
        eyes, sway, hand = np.random.SeedSequence([seed, 2, attempt]).spawn(3)
        self.person: Person = draw_person(np.random.default_rng(character))
        self.eyes = Perception(self.person, np.random.default_rng(eyes))
        self.body = Body(self.person, HumanNoise(int(sway.generate_state(1)[0]), noise))
        self.rng = np.random.default_rng(hand)
        self._belief: Belief | None = None
        self.surprise = np.zeros(2)
        """Position of the robot's head at the last look, relative to where it was believed to be,
        along and across its heading [m]. Shape (2,)."""
        self.follows_head = True
        """Whether the person takes the robot's head for its own. False where only the hand counts
        and the planner may move the rest of the body."""
        self.diary: list[tuple[float, str]] = []
        """Log of (time [s], text) of what the person did, for observers."""

    @property
    def time(self) -> float:
        """The person's own clock [s]."""
        return self.body.time

    @property
    def belief(self) -> Belief:
        """Estimated transform between the robot's world and the person's room."""
        if self._belief is None:
            self._belief = Belief(self.body.compute_head(), self.eyes.pose("head"))
        return self._belief

    def feel(self, name: str) -> np.ndarray:
        """Pose of `left_palm`, `left_wrist`, … as seen, else inferred from the person's own hand.

        Args:
            name: Side and part, joined by an underscore.

        Returns:
            Pose in the robot's world. Shape (7,).
        """
        if self.eyes.sees(name):
            return self.eyes.pose(name)
        side, part = name.split("_")
        own = self.body.compute_hands_in_room()[SIDES.index(side)]
        if part == "palm":
            own = pose_multiply(
                own, make_pose(np.array([WRIST_TO_PALM, 0, 0]), np.array([1.0, 0, 0, 0]))
            )
        point = self.belief.point_to_robot(own[:3], self.body.compute_head())
        return make_pose(point, quat_multiply(quat_from_yaw(self.belief.turn), own[3:]))

    def see(self, view: View) -> None:
        """Receive a view; `look` perceives it after its delay."""
        self.eyes.show(view)

    def look(self, time: float) -> None:
        """Perceive the views that have arrived by `time` [s] of the robot's clock."""
        heading = None
        if self._belief is not None:
            heading = self._belief.turn + float(compute_heading(self.body.compute_head()[3:]))
        self.eyes.advance(time, float(self.body.posture.look[1]), heading)

    def note(self, text: str) -> None:
        """Log `text` in the diary, with the current time."""
        self.diary.append((round(self.time, 2), text))

    def scatter(self, length: float, size: int = 3) -> np.ndarray:
        """Draw the end point error of a movement of `length` [m]. Shape (size,)."""
        return self.person.scatter * length * self.rng.standard_normal(size)

    def miss_level(self) -> np.ndarray:
        """Draw roll and pitch error of a hand that is held level by feel [rad]. Shape (2,)."""
        return self.person.level_error * self.rng.standard_normal(2)

    def make_frame(self, stamp: float) -> OperatorFrame:
        """Return the body's current frame, stamped `stamp` [s]."""
        return self.body.make_frame(stamp)

    def is_still(self, *names: str) -> bool:
        """Whether these frames of the robot are seen to be stationary, or stepping in place."""
        walking = self.eyes.mode is Mode.MOBILE
        limit = self.person.still_walking if walking else self.person.still
        return self.eyes.compute_movement(names) <= limit

    def pause(self, duration: float) -> Doing:
        """Hold still for `duration` [s]."""
        end = self.time + duration
        while self.time < end:
            yield

    def finish(self) -> Doing:
        """Wait until the current movement or pinch is over."""
        while self.body.is_moving or self.body.is_pinching:
            yield

    def settle(self, *names: str, patience: float | None = None) -> Doing:
        """Wait until the robot is seen to be stationary, or patience runs out; then decide.

        People who act over a delay use a move-and-wait strategy (Ferrell 1965): the current image
        shows a robot that has not received all of the movement yet.

        Args:
            names: Frames to watch; head and wrists by default.
            patience: Longest wait [s]; `Person.patience` by default.
        """
        yield from self.finish()
        watched = names or ("head", "left_wrist", "right_wrist")
        yield from self.pause(self.person.delay)
        limit = self.time + (self.person.patience if patience is None else patience)
        while self.time < limit and not self.is_still(*watched):
            yield
        yield from self.pause(self.person.decision_s)
        if self.follows_head:
            self.learn()

    def learn(self) -> None:
        """Correct the belief by where the robot's head is seen relative to the person's own."""
        own, head = self.body.compute_head(), self.eyes.pose("head")
        offset = head[:3] - self.belief.point_to_robot(own[:3], own)
        self.surprise = quat_rotate(quat_from_yaw(-float(compute_heading(head[3:]))), offset)[:2]
        self.belief.learn(own, head, self.person.gain)
