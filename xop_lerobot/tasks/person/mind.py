"""The simulated person: looks, decides, moves; one step of an intention per tick."""

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
)
from xop_lerobot.operator.display import View
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.tasks.person.belief import Belief
from xop_lerobot.tasks.person.body import SIDES, Body
from xop_lerobot.tasks.person.perception import Perception
from xop_lerobot.tasks.person.person import Person, draw_person

PALM = 0.1
"""From a person's wrist to the middle of the palm [m]."""

type Doing = Iterator[None]
"""Something that a person does: a generator that goes on by one tick for each `next`."""


class GaveUp(Exception):
    """The person sees no way to go on."""


class Mind:
    """Eyes, body, belief and chance of one person; what skills and intentions act with.

    Args:
        seed: Seed of the person and of all chance.
        noise: Scale of sway and tremor.
        attempt: Which attempt of this person; another one is another chance.
    """

    def __init__(self, seed: int, noise: float = 1.0, attempt: int = 0) -> None:
        character = np.random.SeedSequence([seed, 2])
        eyes, sway, hand = np.random.SeedSequence([seed, 2, attempt]).spawn(3)
        self.person: Person = draw_person(np.random.default_rng(character))
        self.eyes = Perception(self.person, np.random.default_rng(eyes))
        self.body = Body(self.person, HumanNoise(int(sway.generate_state(1)[0]), noise))
        self.rng = np.random.default_rng(hand)
        self._belief: Belief | None = None
        self.follows_head = True
        """Whether the person takes the robot's head for the own; not where the hand alone counts,
        and the rest of the body may do as it likes."""
        self.diary: list[tuple[float, str]] = []
        """What the person did and when, in words; for people who look on."""

    @property
    def time(self) -> float:
        """The person's own clock [s]."""
        return self.body.time

    @property
    def belief(self) -> Belief:
        """How the robot's world lies on the own room."""
        if self._belief is None:
            self._belief = Belief(self.body.compute_head(), self.eyes.pose("head"))
        return self._belief

    def feel(self, name: str) -> np.ndarray:
        """Where `left_palm` or `left_wrist`, … is: as seen, or where one feels the own to be.

        Args:
            name: Side and part.

        Returns:
            Pose in the robot's world. Shape (7,).
        """
        if self.eyes.sees(name):
            return self.eyes.pose(name)
        side, part = name.split("_")
        own = self.body.compute_hands_in_room()[SIDES.index(side)]
        if part == "palm":
            own = pose_multiply(own, make_pose(np.array([PALM, 0, 0]), np.array([1.0, 0, 0, 0])))
        point = self.belief.point_to_robot(own[:3], self.body.compute_head())
        return make_pose(point, quat_multiply(quat_from_yaw(self.belief.turn), own[3:]))

    def see(self, view: View) -> None:
        """Be shown a view."""
        self.eyes.show(view)

    def look(self, time: float) -> None:
        """Perceive what has arrived by `time` [s] of the robot's clock."""
        heading = None
        if self._belief is not None:
            heading = self._belief.turn + float(compute_heading(self.body.compute_head()[3:]))
        self.eyes.advance(time, float(self.body.posture.look[1]), heading)

    def note(self, text: str) -> None:
        """Write down what is being done."""
        self.diary.append((round(self.time, 2), text))

    def scatter(self, length: float, size: int = 3) -> np.ndarray:
        """By how much a movement of this length misses [m]. Shape (size,)."""
        return self.person.scatter * length * self.rng.standard_normal(size)

    def miss_level(self) -> np.ndarray:
        """Roll and pitch of a hand that is believed to be level [rad]. Shape (2,)."""
        return self.person.level_error * self.rng.standard_normal(2)

    def make_frame(self, stamp: float) -> OperatorFrame:
        """Frame of the body as it is now."""
        return self.body.make_frame(stamp)

    def is_still(self, *names: str) -> bool:
        """Whether the robot's frames are seen to stand still, or to mark time on the spot."""
        walking = self.eyes.mode is Mode.MOBILE
        limit = self.person.still_walking if walking else self.person.still
        return self.eyes.compute_movement(names) <= limit

    def pause(self, duration: float) -> Doing:
        """Stay as one is for `duration` [s]."""
        end = self.time + duration
        while self.time < end:
            yield

    def finish(self) -> Doing:
        """Wait until the movement that is under way is over."""
        while self.body.is_moving or self.body.is_pinching:
            yield

    def settle(self, *names: str, patience: float | None = None) -> Doing:
        """Wait until what one sees of the robot stands still, or patience is lost; then decide.

        People who act over a delay move and wait (Ferrell 1965): the picture of now shows a
        robot that has not had all of the movement yet.
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
        """Take in where the robot's head is seen to be for the own one."""
        self.belief.learn(self.body.compute_head(), self.eyes.pose("head"), self.person.gain)
