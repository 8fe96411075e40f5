"""What one run of the tracking benchmark is made of: robot, settings, ablation, seed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from xop_lerobot.command import Mode
from xop_lerobot.errors import BadValue, UnknownName
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.retarget.config import MpcConfig, RetargeterConfig


@dataclass(frozen=True)
class Ablation:
    """One variant of the retargeter.

    Attributes:
        title: What differs from the default, for tables.
        mpc: Overrides of `MpcConfig` by name, see `override_config`.
        retargeter: Settings of `RetargeterConfig`.
        noise: Preset of the sensors' noise, None for the one that was asked for.
        equal_compute: Whether the number of samples is raised or lowered so that as many physics
            steps per second are rolled out as by the default.
    """

    title: str
    mpc: Mapping[str, Any] = field(default_factory=dict)
    retargeter: Mapping[str, Any] = field(default_factory=dict)
    noise: str | None = None
    equal_compute: bool = False


ABLATIONS: dict[str, Ablation] = {
    "default": Ablation("the default preset"),
    "no_extrapolation": Ablation("no extrapolated terminal state", {"extrapolation_s": 0.0}),
    "no_preview": Ablation("no goal preview", {"preview_s": 0.0}),
    "no_ess": Ablation("raw weights, λ = 0.001", {"weighting": "raw", "temperature": 0.001}),
    "minmax": Ablation("min-max weights, λ = 0.05", {"weighting": "minmax", "temperature": 0.05}),
    "exact": Ablation("no sensor noise", noise="off"),
    "direct": Ablation("direct mapping", retargeter={"type": "direct"}),
}
"""Variants by name: each is the default preset but for what is named."""


@dataclass(frozen=True)
class TrackingSetup:
    """One run, but for its seed.

    Attributes:
        robot: Name of the robot.
        scenario: Name of the scenario.
        ablation: Name of the variant of the retargeter.
        noise: Preset of the sensors' noise.
        preset: Preset of the retargeter.
        sync: Whether the state is synchronised.
        low_level: Name of the low-level policy; empty for the robot's own.
        hold: How long goals are held [s].
        goals: Number of goals of the scenario `room`.
        fps: Rate of the control loop [Hz].
        overrides: Further settings of `MpcConfig`, see `override_config`.
    """

    robot: str
    scenario: str
    ablation: str = "default"
    noise: str = "mild"
    preset: str = "default"
    sync: bool = True
    low_level: str = ""
    hold: float = 10.0
    goals: int = 10
    fps: int = 25
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def compute_key(self, seed: int) -> str:
        """A name of the run with `seed` that changes with any of its settings."""
        settings = json.dumps(dataclasses.asdict(self), sort_keys=True, default=str)
        digest = hashlib.sha256(settings.encode()).hexdigest()[:8]
        return f"{self.robot}/{self.scenario}/{self.ablation}/{seed}/{digest}"

    @property
    def resolved_noise(self) -> str:
        """The noise preset that the run has."""
        return get_ablation(self.ablation).noise or self.noise


def get_ablation(name: str) -> Ablation:
    """Look the ablation `name` up.

    Raises:
        UnknownName: Listing the known ones.
    """
    if name not in ABLATIONS:
        raise UnknownName("ablation", name, ABLATIONS)
    return ABLATIONS[name]


def override_config(config: MpcConfig, overrides: Mapping[str, Any], mode: Mode) -> MpcConfig:
    """Return `config` with some of its values replaced.

    Args:
        config: The robot's own parameters in `mode`.
        overrides: Values by name: a field (``"horizon"``), an entry of a field
            (``"weights.control"``, ``"noise_std.vx"``), or either for one mode alone
            (``"mobile.horizon"``).
        mode: The mode.

    Raises:
        UnknownName: If there is no such field or entry, listing the known ones.
    """
    prefixes = {each.name.lower(): each for each in Mode}
    for name, value in overrides.items():
        head, _, rest = name.partition(".")
        if head in prefixes:
            if prefixes[head] is not mode:
                continue
            head, _, rest = rest.partition(".")
        known = [each.name for each in dataclasses.fields(config)]
        if head not in known:
            raise UnknownName("setting of MpcConfig", head, known)
        config = dataclasses.replace(
            config, **{head: _override_entry(head, getattr(config, head), rest, value)}
        )
    return config


def _override_entry(field_name: str, current: Any, entry: str, value: Any) -> Any:
    """The value of a field with one of its entries, or all of it, replaced."""
    if not entry:
        return value
    if isinstance(current, Mapping):
        return {**current, entry: value}
    if dataclasses.is_dataclass(current) and not isinstance(current, type):
        known = [each.name for each in dataclasses.fields(current)]
        if entry not in known:
            raise UnknownName(f"setting of MpcConfig.{field_name}", entry, known)
        return dataclasses.replace(current, **{entry: value})
    raise BadValue(f"setting '{field_name}' of MpcConfig has no entries, got '{entry}'")


def make_tuned_morphology(setup: TrackingSetup) -> Morphology:
    """Make the robot with the parameters that `setup` asks for, in both modes.

    Raises:
        UnknownName: If a name in it is unknown.
    """
    morphology = make_morphology(setup.robot)
    stock = type(morphology).mpc_config
    ablation = get_ablation(setup.ablation)
    configs = {}
    for mode in Mode:
        own = override_config(stock(morphology, mode), setup.overrides, mode)
        config = override_config(own, ablation.mpc, mode)
        if ablation.equal_compute:
            samples = compute_policy_steps(own) / (config.horizon * config.control_hz)
            config = dataclasses.replace(config, num_samples=max(1, round(samples)))
        configs[mode] = config
    # Only this one robot has other parameters, not its class.
    vars(morphology)["mpc_config"] = configs.__getitem__
    return morphology


def make_retargeter_config(setup: TrackingSetup, seed: int) -> RetargeterConfig:
    """Settings of the retargeter: one thread, the setup's preset, and its ablation.

    Raises:
        UnknownName: If the ablation sets what the retargeter does not have.
    """
    settings: dict[str, Any] = {"threads": 1, "seed": seed}
    settings |= {"preset": setup.preset, "sync": setup.sync}
    settings |= dict(get_ablation(setup.ablation).retargeter)
    known = [each.name for each in dataclasses.fields(RetargeterConfig)]
    for name, value in list(settings.items()):
        if name in known:
            continue
        if (name, value) != ("preset", "default"):
            raise UnknownName("setting of RetargeterConfig", name, known)
        del settings[name]
    return RetargeterConfig(**settings)


def compute_policy_steps(config: MpcConfig) -> float:
    """Low-level control steps that are rolled out per second of the robot's clock [1/s]."""
    return config.num_samples * config.horizon * config.control_hz


def compute_physics_steps(config: MpcConfig, time_step: float) -> float:
    """Physics steps that are rolled out per second of the robot's clock [1/s]."""
    return compute_policy_steps(config) * round(POLICY_DT / time_step)


def parse_overrides(settings: Sequence[str]) -> dict[str, Any]:
    """Read settings ``name=value``, the value as YAML reads it.

    Raises:
        BadValue: If one has no ``=``.
    """
    import yaml  # noqa: PLC0415

    overrides = {}
    for setting in settings:
        name, separator, value = setting.partition("=")
        if not separator:
            raise BadValue(f"a setting reads name=value, got '{setting}'")
        overrides[name] = yaml.safe_load(value)
    return overrides
