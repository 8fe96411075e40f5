"""Configuration of the retargeter; imports no physics, so that plugins load quickly."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import fill_nulls, find_text
from xop_lerobot.morphology.tuning import MpcConfig

RETARGETERS = ("mpc", "direct")
PRESETS = ("default", "conservative", "aggressive", "table1", "table1_charitable")
CONSTRAINTS = ("upright",)
"""Constraints that can be switched on and off while the robot is driven."""


@dataclass
class RetargeterConfig:
    """Settings of the retargeter, as given on the command line.

    Attributes:
        type: `mpc`, or `direct` for the paper's direct-mapping baseline.
        num_samples: Rollouts per solve; 0 takes the robot's own default.
        horizon: Rollout length in control steps; 0 takes the robot's own default.
        control_hz: Solves per second; 0 takes the robot's own default.
        threads: Threads for the rollouts; 0 takes one per core.
        seed: Seed of the samples.
        preset: Settings to start with: `default`, `conservative`, `aggressive`, `table1` or
            `table1_charitable`.
        sync: Whether to synchronise the measured state with the ground contacts before each tick.
        variant: Initial binding of targets to the body, one that the robot names (RB-Y1: `v1`,
            `v2`); empty takes its first.
        targets: Tracked frames that the retargeter follows, separated by commas; empty takes those
            of the variant.
        body: Commands and arm joints that it may move for them, separated by commas; empty takes
            those of the variant.
        constraints: Initial constraints, separated by commas.
        obstacles: YAML file of obstacles, in addition to those fixed in the scene.
    """

    type: str = "mpc"
    num_samples: int = 0
    horizon: int = 0
    control_hz: float = 0.0
    threads: int = 0
    seed: int = 0
    preset: str = "default"
    sync: bool = True
    variant: str = ""
    targets: str = ""
    body: str = ""
    constraints: str = ""
    obstacles: str = ""

    def __post_init__(self) -> None:
        fill_nulls(self)
        for name in ("variant", "targets", "body", "constraints", "obstacles"):
            setattr(self, name, find_text(getattr(self, name)))
        if self.type not in RETARGETERS:
            raise UnknownName("retargeter", self.type, RETARGETERS)
        if self.preset not in PRESETS:
            raise UnknownName("preset", self.preset, PRESETS)
        for name in split_names(self.constraints):
            if name not in CONSTRAINTS:
                raise UnknownName("constraint", name, CONSTRAINTS)
        for name in ("num_samples", "horizon", "control_hz", "threads"):
            if getattr(self, name) < 0:
                raise BadValue(f"{name} must not be negative, got {getattr(self, name)}")

    def override(self, config: MpcConfig) -> MpcConfig:
        """Override a robot's own parameters by those that the user set; zeros keep them."""
        names = ("num_samples", "horizon", "control_hz")
        return replace(
            config, **{name: getattr(self, name) for name in names if getattr(self, name)}
        )

    @property
    def num_threads(self) -> int:
        """Number of threads for the rollouts."""
        return self.threads or len(os.sched_getaffinity(0))


def split_names(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of names; empty for an empty text."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
