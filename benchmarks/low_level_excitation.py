"""Random commands, arm motions and pushes for training and comparing G1's low-level policies.

Any change of the order or number of random draws changes the published comparison
(docs/results/low_level_policies.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from xop_lerobot.core.command import Mode
from xop_lerobot.low_level.joints import read_joints
from xop_lerobot.low_level.policy import POLICY_DT

HEIGHT_NEUTRAL = 0.75
"""Neutral height of G1's pelvis [m]."""
VELOCITIES = slice(4, 7)
"""Velocity entries of G1's command."""


@dataclass(frozen=True)
class ExcitationConfig:
    """Ranges of the random sequences; the defaults are those of the published comparison.

    Attributes:
        height: Range of the base height in stance [m].
        waist_yaw: Maximum waist yaw [rad].
        waist_roll: Maximum waist roll [rad].
        waist_pitch: Range of the waist pitch [rad].
        vx: Maximum forward velocity [m/s].
        vy: Maximum lateral velocity [m/s].
        yaw_rate: Maximum yaw rate [rad/s].
        arm_range: Fraction of each arm joint's range that is used, about its centre.
        arm_speed: Maximum speed of the arm targets [rad/s].
        push: Maximum change of the base's planar velocity by a push [m/s].
        push_period: Mean time between pushes [s].
        hand_force: Maximum force on each hand along each axis [N].
    """

    height: tuple[float, float] = (0.5, 0.75)
    waist_yaw: float = 0.8
    waist_roll: float = 0.0
    waist_pitch: tuple[float, float] = (0.0, 0.0)
    vx: float = 0.6
    vy: float = 0.4
    yaw_rate: float = 0.6
    arm_range: float = 0.8
    arm_speed: float = 1.5
    push: float = 0.5
    push_period: float = 5.0
    hand_force: float = 0.0


@dataclass(frozen=True)
class Excitation:
    """Random inputs of `n` robots over `steps` policy steps.

    Attributes:
        command: Commands. Shape (steps, n, 7).
        mode: Modes. Shape (steps, n).
        arms: Arm targets [rad]. Shape (steps, n, 14).
        push: Sudden change of the base's planar velocity, world [m/s]. Shape (steps, n, 2).
        hand_force: Force on the left and right hand, world [N]. Shape (steps, n, 2, 3).
    """

    command: np.ndarray
    mode: np.ndarray
    arms: np.ndarray
    push: np.ndarray
    hand_force: np.ndarray


def make_excitation(
    rng: np.random.Generator, n: int, steps: int, config: ExcitationConfig
) -> Excitation:
    """Draw random sequences: targets held for some seconds, reached by steps or ramps.

    Args:
        rng: Random generator.
        n: Number of robots.
        steps: Policy steps of 20 ms.
        config: Ranges.
    """
    mode = (_hold(rng, n, steps, (2.0, 7.0))[..., 0] < 0.5).astype(int)
    low = np.array([config.height[0], -config.waist_yaw, -config.waist_roll])
    low = np.concatenate([low, config.waist_pitch[:1], [-config.vx, -config.vy, -config.yaw_rate]])
    high = np.array([config.height[1], config.waist_yaw, config.waist_roll])
    high = np.concatenate([high, config.waist_pitch[1:], [config.vx, config.vy, config.yaw_rate]])
    neutral = np.array([HEIGHT_NEUTRAL, 0, 0, 0, 0, 0, 0])
    neutral[0] = min(neutral[0], config.height[1])
    target = low + (high - low) * _hold(rng, n, steps, (1.0, 5.0), low.size)
    # Each entry stays neutral 40 % of the time.
    keep = _hold(rng, n, steps, (1.0, 5.0), low.size) < 0.6
    target = np.where(keep, target, neutral)
    target[..., VELOCITIES] *= (mode == Mode.MOBILE)[..., None]
    slow = np.array([0.05, 0.3, 0.2, 0.2, 0.5, 0.5, 0.5])
    fast = np.array([0.5, 3.0, 1.0, 1.0, 5.0, 5.0, 5.0])
    # Log-uniform between a slow ramp and nearly a step.
    rate = slow * (fast / slow) ** _hold(rng, n, steps, (1.0, 5.0), low.size)
    command = _follow(target, rate, np.tile(neutral, (n, 1)))
    arms = _make_arms(rng, n, steps, config)
    push = _make_pushes(rng, n, steps, config)
    force = config.hand_force * (2 * _hold(rng, n, steps, (1.0, 4.0), 6) - 1)
    force *= _hold(rng, n, steps, (2.0, 6.0)) < 0.5
    return Excitation(command, mode, arms, push, force.reshape(steps, n, 2, 3))


def _hold(
    rng: np.random.Generator, n: int, steps: int, seconds: tuple[float, float], size: int = 1
) -> np.ndarray:
    """Draw uniform numbers in [0, 1), each held for a random time. Shape (steps, n, size)."""
    values = np.empty((steps, n, size))
    for robot in range(n):
        for channel in range(size):
            start = 0
            while start < steps:
                length = max(1, round(rng.uniform(*seconds) / POLICY_DT))
                values[start : start + length, robot, channel] = rng.uniform()
                start += length
    return values


def _follow(target: np.ndarray, rate: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Limit the rate of `target` to `rate` per second, from `start`. Shape (steps, n, k)."""
    path, now = np.empty_like(target), start
    for step in range(len(target)):
        limit = rate[step] * POLICY_DT
        now = now + np.clip(target[step] - now, -limit, limit)
        path[step] = now
    return path


def _make_arms(
    rng: np.random.Generator, n: int, steps: int, config: ExcitationConfig
) -> np.ndarray:
    joints = read_joints("g1")
    low, high = joints.low[joints.arms], joints.high[joints.arms]
    middle, half = (low + high) / 2, (high - low) / 2
    target = middle + config.arm_range * half * (2 * _hold(rng, n, steps, (1, 4), 14) - 1)
    # Part of the time both arms rest, or all joints stay within a third of their range.
    posture = _hold(rng, n, steps, (3.0, 8.0))
    target = np.where(posture < 0.2, 0.0, np.where(posture < 0.6, target / 3, target))
    rate = config.arm_speed * (0.2 + 0.8 * _hold(rng, n, steps, (1, 4), len(low)))
    path = _follow(target, rate, np.zeros((n, len(low))))
    smooth = np.empty_like(path)
    now = path[0]
    for step in range(steps):  # a first-order lag of 0.1 s rounds the corners of the ramps
        now = now + (path[step] - now) * (POLICY_DT / 0.1)
        smooth[step] = now
    return smooth


def _make_pushes(
    rng: np.random.Generator, n: int, steps: int, config: ExcitationConfig
) -> np.ndarray:
    push = np.zeros((steps, n, 2))
    if config.push <= 0:
        return push
    happens = rng.uniform(size=(steps, n)) < POLICY_DT / config.push_period
    happens[:50] = False  # the first second is for standing up
    count = int(happens.sum())
    angle, size = rng.uniform(-np.pi, np.pi, count), rng.uniform(0, config.push, count)
    push[happens] = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=1)
    return push
