"""Parameters of the simulated person, with units and sources."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Person:
    """Parameters of one person; `docs/how_it_works/operator.md` has the sources.

    Attributes:
        eye_height: Height of the eyes over the floor, standing [m].
        leg_bend: How far the eyes can be lowered by squatting [m].
        reach: Distance ahead of the eyes at which the hands of a person with eyes at 1.6 m work
            comfortably [m].
        reach_low: How far below the eyes they still do [m].
        reach_high: How far below the eyes they do at least [m].
        display_delay: From an event at the robot to its picture in the headset [s].
        visual_delay: From the picture to what the person knows of it [s].
        decision_s: Time to decide on the next movement, once the picture stands still [s].
        view_half_angles: Half of the field of view, sideways and up or down [rad].
        depth_bias: Standard deviation between persons of the error of distances, relative.
        depth_noise: Error of a thing's distance, over its distance.
        side_noise: Error of a thing's place across the line of sight, over its distance.
        place_noise: Error that remains at any distance [m].
        noise_s: Time over which such an error lasts [s].
        fitts_a: Intercept of Fitts's law [s].
        fitts_b: Its slope [s/bit].
        care: Factor on the time of a reach: a robot is moved with more care than a stylus.
        hand_speed: Largest mean speed of a hand [m/s].
        hand_width: Width of the target that a reach is timed for [m].
        posture_speed: Mean speed of the head when squatting or leaning [m/s].
        walk_speed: Speed of walking [m/s].
        walk_start: Time to reach it, and to stop [s].
        turn_speed: Peak rate of turning the body or the head [rad/s].
        step_length: Distance up to which a person steps sideways or back, rather than turn [m].
        scatter: Standard deviation of where a movement ends, over its length.
        level_error: Standard deviation of the turn of a hand that is held level by feel, about
            each axis, drawn anew with each movement [rad].
        gain: Share of a seen error that one correction takes out.
        hand_gain: The same of a hand.
        patience: Longest wait until what is seen stands still [s].
        still: Movement in 0.4 s below which a thing stands still [m].
        still_walking: The same in mobile mode, where a legged robot marks time [m].
        place_tolerance: How far beside where a person wants to stand is good enough [m].
        heading_tolerance: The same of the heading [rad].
        hand_tolerance: Distance from palm to point that is good enough [m].
        corrections: Number of corrections after which another way is tried.
        time_limit: Time after which the person gives up [s].
    """

    eye_height: float = 1.60
    leg_bend: float = 0.45
    reach: float = 0.42
    reach_low: float = 0.50
    reach_high: float = 0.12
    display_delay: float = 0.135
    visual_delay: float = 0.11
    decision_s: float = 0.25
    view_half_angles: tuple[float, float] = (0.96, 0.84)
    depth_bias: float = 0.03
    depth_noise: float = 0.012
    side_noise: float = 0.004
    place_noise: float = 0.002
    noise_s: float = 1.5
    fitts_a: float = 0.013
    fitts_b: float = 0.095
    care: float = 2.0
    hand_speed: float = 0.3
    hand_width: float = 0.05
    posture_speed: float = 0.16
    walk_speed: float = 0.55
    walk_start: float = 1.0
    turn_speed: float = 0.9
    step_length: float = 0.6
    scatter: float = 0.03
    level_error: float = 0.08
    gain: float = 0.85
    hand_gain: float = 0.75
    patience: float = 1.5
    still: float = 0.008
    still_walking: float = 0.03
    place_tolerance: float = 0.07
    heading_tolerance: float = 0.12
    hand_tolerance: float = 0.028
    corrections: int = 6
    time_limit: float = 150.0

    @property
    def size(self) -> float:
        """Height over that of the person whose lengths are given here."""
        return self.eye_height / Person.eye_height

    @property
    def delay(self) -> float:
        """From an event at the robot to what the person knows of it [s]."""
        return self.display_delay + self.visual_delay


def draw_person(rng: np.random.Generator) -> Person:
    """Draw the parameters of one person.

    Args:
        rng: Source of the person.
    """
    mean = Person()
    quick = float(np.clip(rng.normal(1.0, 0.08), 0.85, 1.15))
    return replace(
        mean,
        eye_height=float(np.clip(rng.normal(mean.eye_height, 0.06), 1.45, 1.75)),
        visual_delay=mean.visual_delay * float(np.clip(rng.normal(1.0, 0.1), 0.8, 1.2)),
        decision_s=mean.decision_s / quick,
        care=mean.care / quick,
        hand_speed=mean.hand_speed * quick,
        posture_speed=mean.posture_speed * quick,
        walk_speed=min(mean.walk_speed * quick, 0.6),
        turn_speed=min(mean.turn_speed * quick, 1.0),
    )
