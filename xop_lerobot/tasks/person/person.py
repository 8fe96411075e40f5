"""Parameters of the simulated person, with units; sources in `docs/how_it_works/operator.md`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Person:
    """Parameters of one person.

    Attributes:
        eye_height: Height of the eyes above the floor, standing [m].
        leg_bend: Largest lowering of the eyes by bending the knees [m].
        reach: Comfortable working distance of the hands ahead of the eyes, for eyes at 1.6 m [m].
        reach_low: Lower end of the comfortable range, below the eyes [m].
        reach_high: Upper end of the comfortable range, below the eyes [m].
        display_delay: From an event at the robot to its image in the headset [s].
        visual_delay: From the image to the person's knowledge of it [s].
        decision_s: Time to decide on the next movement once the image is stationary [s].
        view_half_angles: Half of the field of view, horizontal and vertical [rad].
        depth_bias: Standard deviation between persons of the relative error of distance [1].
        depth_noise: Error along the line of sight, relative to the distance [1].
        side_noise: Error across the line of sight, relative to the distance [1].
        place_noise: Position error that remains at any distance [m].
        noise_s: Correlation time of these errors [s].
        fitts_a: Intercept of Fitts's law [s].
        fitts_b: Slope of Fitts's law [s/bit].
        care: Factor on the time of a reach; people move a robot more carefully than a stylus [1].
        hand_speed: Largest mean speed of a hand [m/s].
        hand_width: Target width in Fitts's law [m].
        posture_speed: Mean speed of the head while squatting or leaning [m/s].
        walk_speed: Walking speed [m/s].
        walk_start: Time to accelerate to it, and to stop [s].
        turn_speed: Peak turn rate of body or head [rad/s].
        step_length: Distance up to which the person sidesteps or steps back rather than turning
            [m].
        scatter: Standard deviation of a movement's end point, relative to its length [1].
        level_error: Standard deviation of the tilt of a hand held level by feel, about each axis,
            drawn for each movement [rad].
        gain: Share of a seen error that one correction removes [1].
        hand_gain: The same for corrections of a hand [1].
        patience: Longest wait for the image to become stationary [s].
        still: Movement within 0.4 s below which something counts as stationary [m].
        still_walking: The same in mobile mode, where a legged robot steps in place [m].
        place_tolerance: Accepted error of the standing position [m].
        heading_tolerance: Accepted error of the heading [rad].
        hand_tolerance: Accepted distance between palm and target point [m].
        corrections: Number of failed corrections after which another strategy is tried.
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

    @property
    def size(self) -> float:
        """Eye height relative to the default person, for whom the lengths are given [1]."""
        return self.eye_height / Person.eye_height

    @property
    def delay(self) -> float:
        """From an event at the robot to the person's knowledge of it [s]."""
        return self.display_delay + self.visual_delay


def draw_person(rng: np.random.Generator) -> Person:
    """Draw the parameters of one person.

    Args:
        rng: Random generator; equal states give equal persons.
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
