"""Planner parameters of a robot: cost weights, controller parameters, and driving limits."""

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
AIDS = ("drift", "offset", "postures", "route", "sway", "intervention")


@dataclass(frozen=True)
class CostWeights:
    """Weights of the cost terms (Eq. 3); docs/how_it_works/retargeter.md has the formulas.

    Attributes:
        position: w_p, squared position error of each tracked frame [1/m²].
        orientation: w_θ, squared orientation error of each tracked frame [1/rad²].
        tilt_share: κ, weight of a tilt relative to a heading error [1].
        stance: w_s, squared velocity of the points in contact [s²/m²].
        collision: w_c, proximity to obstacles [1].
        collision_velocity: w_v, speed near obstacles [s²/m²].
        collision_decay: α, decay of the proximity with the distance [1/m].
        collision_velocity_decay: β, decay of the speed's term with the distance [1/m].
        collision_range: Distance from which an obstacle costs nothing; may be infinite [m].
        upright: Squared tilt of each hand under the upright constraint [1].
        control: w_a, squared deviation of the command from its reference, in half ranges [1], or in
            the entries' own units (`MpcConfig.scale_control`).
        change: Squared change of the command from the executed one, in half ranges [1].
        terminal: w_f, factor on the tracking cost at the end of the extrapolation [1].
        support: Squared distance of the centre of mass beyond the safe support area [1/m²].
        lean: Squared distance of the centre of mass from its rest position on the base [1/m²].
        load: Squared static torque of a joint beyond its allowed share of the motor limit [1].
        lateral: Squared heading error of a wheeled base [1/rad²].
        fall: Squared tilt of the base beyond the safe one, and height below the safe one [1].
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
    """Parameters of the model predictive controller of one robot in one mode.

    Attributes:
        optimizer: Name of the sampling optimizer: `kmppi`, or a registered one.
        num_samples: Rollouts per solve N, fixed candidates included [1].
        horizon: Length H of a rollout in low-level control steps of 20 ms [1].
        num_knots: Support points of the kernel interpolation [1].
        kernel_width: Width σ of the kernel [control steps].
        kernel_mean: Mean of the interpolation: the last support value (`hold`), so that a constant
            command persists, or `zero`, as in the original KMPPI.
        shift: Shift of the plan between two solves: by the elapsed time (`measured`), or always
            by `one` control step, as in the original.
        sampling: Kind of sampling noise: `gaussian` or `antithetic`.
        sample_plan: Whether the plan itself is the first sample.
        noise_std: Standard deviation of the samples by command name [its unit].
        temperature: λ of weighting `raw`, and of `importance_cost` [cost].
        effective_samples: Effective sample size that weighting `ess` aims at [1].
        weighting: How costs become weights: `raw` or `ess`.
        importance_cost: Whether MPPI's importance-sampling term is part of the cost.
        min_noise: Fraction of `noise_std` that remains at the goal [1].
        full_noise_error: Tracking error from which the full noise is used [m, rad].
        control_hz: Solves per second of the robot's clock [Hz].
        preview_s: Time for which a goal is assumed to keep its velocity [s].
        extrapolation_s: Time over which the terminal state is extrapolated [s].
        reach: Distance to which a goal is limited [m]; a larger error would only contort the
            robot.
        proposal_s: Time in which the kinematic proposal reaches the goal [s].
        candidates: Fixed commands that are tried beside the samples: the kinematic `proposal`;
            `paced`, the proposal scaled so that all entries arrive together, within two control
            periods, for chains whose slow joints would lag behind; the `direct` mapping; the
            `previous` (executed) command; and `stop`.
        control_reference: Command of zero control cost: the `proposal`, `neutral`, or `zero` as in
            the paper.
        scale_control: Whether the control cost measures each entry in half its range, or, as in the
            paper, in its own unit.
        aids: Parts around the optimisation that the paper does not have: `drift` of a walking base
            and steady-state `offset` of height and joints, observed and compensated; `postures`,
            which limit the head's goal to what the robot can reach; the `route` of a wheeled base,
            with its heading; `sway`, small velocities that shift the weight of a standing robot;
            and the `intervention`, which slows down or vetoes a plan.
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
    scale_control: bool = True
    aids: tuple[str, ...] = AIDS
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
        for what, names, known in (
            ("candidate", self.candidates, CANDIDATES),
            ("aid", self.aids, AIDS),
        ):
            for name in names:
                if name not in known:
                    raise UnknownName(what, name, known)
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
    """Parameters of the paper's Table I for one robot and mode; the others are common to all.

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
    """Limits of a nonholonomic base for driving along a path without tipping its upper body.

    Attributes:
        speed: Largest speed [m/s].
        acceleration: Linear acceleration [m/s²].
        braking: Linear deceleration [m/s²].
        turn: Largest yaw rate [rad/s].
        turn_acceleration: Angular acceleration [rad/s²].
        turn_braking: Angular deceleration [rad/s²].
        centripetal: Largest lateral acceleration, at which a tall robot does not tip [m/s²].
        detour_speed: Speed of a straight drive that makes room for a turn [m/s].
        waist: Largest twist of the waist [rad].
        waist_speed: Speed of the waist [rad/s].
        arrival_twist: Largest waist twist at arrival [rad].
        turning_twist: The same for a turning goal [rad].
        lean: Distance to the goal that the torso can bridge [m].
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
