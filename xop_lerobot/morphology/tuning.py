"""What a robot says of its planner: weights of the costs and parameters of the controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from xop_lerobot.core.errors import BadValue, UnknownName

WEIGHTINGS = ("raw", "ess")
SAMPLINGS = ("gaussian", "antithetic")
KERNEL_MEANS = ("hold", "zero")
SHIFTS = ("measured", "one")
CANDIDATES = ("proposal", "paced", "direct", "previous", "stop")
CONTROL_REFERENCES = ("proposal", "neutral", "zero")


@dataclass(frozen=True)
class CostWeights:
    """Weights of the cost terms (Eq. 3); docs/how_it_works/retargeter.md has the formulas.

    Attributes:
        position: w_p, squared position error of each tracked frame [1/m²].
        orientation: w_θ, squared orientation error of each tracked frame [1/rad²].
        tilt_share: Weight of a tilt over that of a turn about the vertical [1].
        stance: w_s, squared velocity of the points in contact [s²/m²].
        collision: w_c, proximity to obstacles [1].
        collision_velocity: w_v, speed near obstacles [s²/m²].
        collision_decay: α, decay of the proximity with the distance [1/m].
        collision_velocity_decay: β, decay of the speed's term with the distance [1/m].
        collision_range: Distance from which an obstacle costs nothing; may be infinite [m].
        upright: Squared tilt of each hand that is to stay level, while any is [1].
        control: w_a, squared deviation of the command from its reference, each entry over its
            scale [1].
        change: Squared change of the command from the one being executed, each entry over its
            scale [1].
        terminal: w_f, factor on the tracking cost at the end of the horizon [1].
        support: Squared distance of the zero-moment point out of the safe support area [1/m²].
        lean: Squared distance of the centre of mass from where it rests on the base [1/m²].
        load: Squared static torque of a joint beyond its share of what its motor can [1].
        lateral: Squared angle of a base on wheels to where it shall face [1/rad²].
        fall: Squared tilt of the base over the safe one, and height under it [1].
    """

    position: float = 1.0
    orientation: float = 0.1
    tilt_share: float = 1.0
    stance: float = 0.01
    collision: float = 1.0
    collision_velocity: float = 1.0
    collision_decay: float = 50.0
    collision_velocity_decay: float = 25.0
    collision_range: float = 1.0
    upright: float = 1.0
    control: float = 0.002
    change: float = 0.0
    terminal: float = 2.0
    fall: float = 100.0
    support: float = 1000.0
    lean: float = 0.0
    load: float = 100.0
    lateral: float = 0.0


@dataclass(frozen=True)
class MpcConfig:
    """Model predictive controller of one robot in one mode.

    Attributes:
        optimizer: Name of the sampling optimizer: `kmppi`, or a registered one.
        num_samples: Rollouts per solve N, fixed candidates included [1].
        horizon: Length H of a rollout in low-level control steps of 20 ms [1].
        num_knots: Support points of the kernel interpolation [1].
        kernel_width: Width σ of the kernel [control steps].
        kernel_mean: Mean of the interpolation: the last support value (`hold`), so that a steady
            command stays, or `zero`, as in the original KMPPI.
        shift: How far the plan moves between two solves: by the time that has passed
            (`measured`), or by `one` control step whatever the time, as in the original.
        sampling: How noise is drawn: `gaussian` or `antithetic`.
        sample_plan: Whether the plan itself is the first sample.
        noise_std: Standard deviation of the samples by command name [its unit].
        temperature: λ of weighting `raw`, and of `importance_cost` [cost].
        effective_samples: Effective sample size that weighting `ess` aims at [1].
        weighting: How costs become weights: `raw` or `ess`.
        importance_cost: Whether MPPI's importance-sampling term is part of the cost.
        min_noise: Share of `noise_std` that is left when the robot is at its goal [1].
        full_noise_error: Tracking error at which the noise is full [m, rad].
        control_hz: Solves per second of the robot's clock [Hz].
        preview_s: Time over which a goal is assumed to keep its velocity [s].
        extrapolation_s: Time over which the terminal state is extrapolated [s].
        reach: Distance at which a goal that runs away is held [m]; beyond it more error would
            only contort the robot.
        proposal_s: Time in which the kinematic candidate wants to be at the goal [s].
        candidates: Fixed commands that are tried beside the samples: the kinematic `proposal`;
            `paced`, so much of it that all entries are there at once, within two control
            periods, for chains whose slow joints would lag behind; the `direct` mapping; the
            `previous` command, which is still executed; and `stop`.
        control_reference: Command from which the control cost counts: the `proposal`, `neutral`,
            or `zero` as in the paper.
        observe_drift: Whether a steady drift of a walking base, and where height and joints rest
            beside their command, are observed and counted on.
        weights: Cost weights.
    """

    num_samples: int
    horizon: int
    noise_std: dict[str, float]
    optimizer: str = "kmppi"
    num_knots: int = 1
    kernel_width: float = 2.0
    kernel_mean: str = "hold"
    shift: str = "measured"
    sampling: str = "antithetic"
    sample_plan: bool = True
    temperature: float = 0.05
    effective_samples: float = 4.0
    weighting: str = "ess"
    importance_cost: bool = False
    min_noise: float = 0.15
    full_noise_error: float = 0.2
    control_hz: float = 25.0
    preview_s: float = 0.3
    extrapolation_s: float = 0.4
    proposal_s: float = 0.6
    reach: float = 0.6
    candidates: tuple[str, ...] = ("proposal", "previous", "stop")
    control_reference: str = "proposal"
    observe_drift: bool = True
    weights: CostWeights = field(default_factory=CostWeights)

    def __post_init__(self) -> None:
        for name, known in (
            ("weighting", WEIGHTINGS),
            ("sampling", SAMPLINGS),
            ("kernel_mean", KERNEL_MEANS),
            ("shift", SHIFTS),
            ("control_reference", CONTROL_REFERENCES),
        ):
            if getattr(self, name) not in known:
                raise UnknownName(name, getattr(self, name), known)
        for name in self.candidates:
            if name not in CANDIDATES:
                raise UnknownName("candidate", name, CANDIDATES)
        for name in ("num_samples", "horizon", "num_knots", "effective_samples"):
            _check_range(name, getattr(self, name), 1)
        for name in ("num_samples", "horizon", "num_knots"):
            if getattr(self, name) != int(getattr(self, name)):
                raise BadValue(f"{name} must be a whole number, got {getattr(self, name)}")
        positive = ("kernel_width", "temperature", "full_noise_error", "control_hz")
        for name in (*positive, "proposal_s"):
            _check_positive(name, getattr(self, name))
        if not self.reach > 0:  # may be infinite
            raise BadValue(f"reach must be positive, got {self.reach}")
        for name in ("preview_s", "extrapolation_s", "min_noise"):
            _check_range(name, getattr(self, name), 0)
        for name, value in self.noise_std.items():
            _check_range(f"noise_std of {name!r}", value, 0)


@dataclass(frozen=True)
class PaperParameters:
    """What the paper's Table I gives for one robot and mode; the rest is common to all.

    Attributes:
        num_samples: N [1].
        horizon: H [20 ms].
        noise_std: Standard deviation of the samples, one for all entries [their unit].
        control_hz: Solves per second [Hz].
    """

    num_samples: int
    horizon: int
    noise_std: float
    control_hz: float


@dataclass(frozen=True)
class Driving:
    """How a base that cannot go sideways drives along a path, gently enough for what stands on it.

    Attributes:
        speed: Largest speed [m/s].
        acceleration: Of the drive [m/s²].
        braking: Of the drive [m/s²].
        turn: Largest yaw rate [rad/s].
        turn_acceleration: Of the turn [rad/s²].
        turn_braking: Of the turn [rad/s²].
        centripetal: Largest acceleration across the heading: a tall robot tips over [m/s²].
        detour_speed: Speed of a drive that makes room for a turn [m/s].
        waist: Largest twist of the waist that turns the head [rad].
        waist_speed: Its speed [rad/s].
        arrival_twist: Largest twist in which the robot arrives [rad].
        turning_twist: The same behind a goal that turns [rad].
        lean: Distance that the torso bridges by itself [m].
    """

    speed: float
    acceleration: float
    braking: float
    turn: float
    turn_acceleration: float
    turn_braking: float
    centripetal: float
    detour_speed: float
    waist: float
    waist_speed: float
    arrival_twist: float
    turning_twist: float
    lean: float


def _check_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise BadValue(f"{name} must be positive and finite, got {value}")


def _check_range(name: str, value: float, low: float) -> None:
    if not (math.isfinite(value) and value >= low):
        raise BadValue(f"{name} must be at least {low}, got {value}")
