"""Setup of one run of the tracking benchmark (robot, scenario, settings) and its ablations."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

from xop_lerobot.core.command import Mode
from xop_lerobot.core.command_line import split_pair
from xop_lerobot.core.errors import BadValue, UnknownName
from xop_lerobot.core.yaml_words import load_yaml
from xop_lerobot.low_level.policy import POLICY_DT
from xop_lerobot.morphology.morphology import Morphology, make_morphology
from xop_lerobot.morphology.tuning import MpcConfig
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.retarget.presets import build_configs


@dataclass(frozen=True)
class Without:
    """An override that removes one entry from a tuple.

    Attributes:
        entry: The removed entry.
    """

    entry: str


@dataclass(frozen=True)
class Ablation:
    """One variant of the retargeter.

    Attributes:
        title: Difference from the default, for tables.
        mpc: Overrides of `MpcConfig` by name, see `override_config`.
        preset: Preset that the variant starts from, None for the setup's.
        retargeter: Settings of `RetargeterConfig`.
        noise: Preset of the sensor noise, None for the setup's.
        equal_compute: Whether to choose the number of samples so that as many physics steps per
            second are rolled out as without the ablation.
        replaced: Functions to replace, as ``"module:name"``, and a factory that makes each
            replacement from the original. For parts that no setting switches off.
    """

    title: str
    mpc: Mapping[str, Any] = field(default_factory=dict)
    preset: str | None = None
    retargeter: Mapping[str, Any] = field(default_factory=dict)
    noise: str | None = None
    equal_compute: bool = False
    replaced: Mapping[str, Callable[[Callable[..., Any]], Callable[..., Any]]] = field(
        default_factory=dict
    )

    @contextmanager
    def replace(self) -> Iterator[None]:
        """Apply the replacements while the context is open."""
        with ExitStack() as stack:
            for place, make in self.replaced.items():
                owner, _, name = place.replace(":", ".").rpartition(".")
                stock = getattr(resolve_name(owner), name)
                stack.enter_context(patch.object(resolve_name(owner), name, make(stock)))
            yield


def _always(value: object) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a factory of replacements that only return `value`."""
    return lambda _stock: lambda *_args, **_kwargs: value


ABLATIONS: dict[str, Ablation] = {
    "default": Ablation("the default preset"),
    "table1": Ablation("our Table I, its own numbers", preset="table1"),
    "table1_equal": Ablation("our Table I, equal compute", preset="table1", equal_compute=True),
    "table1_charitable": Ablation("its charitable reading", preset="table1_charitable"),
    "table1_charitable_equal": Ablation(
        "the same, equal compute", preset="table1_charitable", equal_compute=True
    ),
    "no_extrapolation": Ablation("no extrapolated terminal state", {"extrapolation_s": 0.0}),
    "no_hold_kernel": Ablation("kernel of zero mean", {"kernel_mean": "zero"}),
    "no_time_shift": Ablation("one control step of shift", {"shift": "one"}),
    "no_proposal": Ablation(
        "no kinematic proposal",
        {"candidates": Without("proposal"), "control_reference": "neutral"},
    ),
    "no_candidates": Ablation(
        "no fixed candidates", {"candidates": (), "control_reference": "neutral"}
    ),
    "no_preview": Ablation("no goal preview", {"preview_s": 0.0}),
    "no_drift": Ablation("no drift observer", {"aids": Without("drift")}),
    "no_offset": Ablation("no offset observer", {"aids": Without("offset")}),
    "no_postures": Ablation("no postures for the head's goal", {"aids": Without("postures")}),
    "no_sway": Ablation("no weight shift in standing", {"aids": Without("sway")}),
    "no_change": Ablation("no cost of change", {"weights.change": 0.0}),
    "no_support": Ablation("no support cost", {"weights.support": 0.0}),
    "no_lean": Ablation("no cost of leaning", {"weights.lean": 0.0}),
    "no_load": Ablation("no cost of static load", {"weights.load": 0.0}),
    "no_lateral": Ablation("no lateral cost", {"weights.lateral": 0.0}),
    "no_stance": Ablation("no stance cost", {"weights.stance": 0.0}),
    "no_fall": Ablation("no fall cost", {"weights.fall": 0.0}),
    "no_reach": Ablation("goals however far away", {"reach": math.inf}),
    "no_previous": Ablation(
        "no previous command as a candidate", {"candidates": Without("previous")}
    ),
    "no_stop": Ablation("no candidate that stops", {"candidates": Without("stop")}),
    "two_knots": Ablation("two support points", {"num_knots": 2}),
    "four_knots": Ablation("four support points", {"num_knots": 4}),
    "no_intervention": Ablation("nothing is slowed or vetoed", {"aids": Without("intervention")}),
    "no_route": Ablation("no path and no heading for wheels", {"aids": Without("route")}),
    "no_hold": Ablation(
        "what hands hold does not go with the body",
        replaced={"xop_lerobot.retarget.arms.contact:ArmHold.update": _always(None)},
    ),
    "no_yield": Ablation(
        "hands that squeeze give no way",
        replaced={"xop_lerobot.retarget.arms.contact:ArmYield.update": _always(None)},
    ),
    "no_bias": Ablation(
        "what arms miss is not made up for",
        replaced={"xop_lerobot.retarget.arms.contact:ArmBias.update": _always(None)},
    ),
    "no_straight": Ablation(
        "each joint at its own rate",
        replaced={
            "xop_lerobot.core.command:CommandSpace.straighten": lambda _stock: (
                lambda _space, step, _missing: step
            ),
        },
    ),
    "no_ess": Ablation("raw weights, λ = 0.001", {"weighting": "raw", "temperature": 0.001}),
    "gaussian": Ablation("Gaussian samples", {"sampling": "gaussian"}),
    "raw_noise": Ablation(
        "Gaussian samples, full width at the goal too", {"sampling": "gaussian", "min_noise": 1.0}
    ),
    "no_sync": Ablation("no state synchronisation", retargeter={"sync": False}),
    "exact": Ablation("no sensor noise", noise="off"),
    "exact_no_sync": Ablation(
        "no sensor noise, no synchronisation", retargeter={"sync": False}, noise="off"
    ),
    "harsh": Ablation("harsh sensor noise", noise="harsh"),
    "harsh_no_sync": Ablation(
        "harsh sensor noise, no synchronisation", retargeter={"sync": False}, noise="harsh"
    ),
    "direct": Ablation("direct mapping", retargeter={"type": "direct"}),
}
"""Variants by name: the setup's preset with the given differences."""

SYNC_VARIANTS = ("default", "no_sync", "exact", "exact_no_sync", "harsh", "harsh_no_sync")
"""Variants that show the effect of the state synchronisation."""


@dataclass(frozen=True)
class TrackingSetup:
    """Everything that determines a run, except its seed.

    Attributes:
        robot: Name of the robot.
        scenario: Name of the scenario.
        ablation: Name of the variant of the retargeter.
        noise: Preset of the sensor noise.
        preset: Preset of the retargeter.
        sync: Whether the state is synchronised.
        low_level: Name of the low-level policy; empty for the robot's own.
        low_level_path: File of the low-level policy; empty for its default.
        hold: Time for which goals are held [s].
        goals: Number of goals of the scenario `room`.
        payload: Mass in each hand, unknown to the planner [kg].
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
    low_level_path: str = ""
    hold: float = 10.0
    goals: int = 10
    payload: float = 0.0
    fps: int = 25
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def compute_key(self, seed: int) -> str:
        """Compute the name of the run with `seed`; any resolved setting changes its digest."""
        configs = {mode.name: dataclasses.asdict(each) for mode, each in self.resolve().items()}
        # The location of a policy's file does not change a run.
        own = dataclasses.replace(self, low_level_path="")
        settings = [dataclasses.asdict(own), configs]
        text = json.dumps(settings, sort_keys=True, default=str)
        digest = hashlib.sha256(text.encode()).hexdigest()[:8]
        return f"{self.robot}/{self.scenario}/{self.ablation}/{seed}/{digest}"

    def resolve(self) -> dict[Mode, MpcConfig]:
        """Resolve the planner's parameters of both modes; see `resolve_configs`."""
        return resolve_configs(self)

    @property
    def is_standard(self) -> bool:
        """Whether only the ablation, hold and goals differ from the defaults, as in documents."""
        standard = TrackingSetup(self.robot, self.scenario, self.ablation)
        free = {name: getattr(standard, name) for name in ("hold", "goals")}
        return dataclasses.replace(self, **free) == standard

    @property
    def resolved_noise(self) -> str:
        """The noise preset of the run: the ablation's, else the setup's."""
        return get_ablation(self.ablation).noise or self.noise


def get_ablation(name: str) -> Ablation:
    """Return the ablation `name`.

    Raises:
        UnknownName: Listing the known ones.
    """
    if name not in ABLATIONS:
        raise UnknownName("ablation", name, ABLATIONS)
    return ABLATIONS[name]


def override_config(config: MpcConfig, overrides: Mapping[str, Any], mode: Mode) -> MpcConfig:
    """Return a copy of `config` with some values replaced.

    Args:
        config: The robot's own parameters in `mode`.
        overrides: Values by name: a field (``"horizon"``), an entry of a field
            (``"weights.control"``, ``"noise_std.vx"``), or either for one mode alone
            (``"mobile.horizon"``).
        mode: The mode.

    Raises:
        UnknownName: If there is no such field or entry, listing the known ones.
        BadValue: If a field without entries is given one.
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
    """Return the value of a field with one of its entries, or all of it, replaced."""
    if isinstance(value, Without):
        return tuple(each for each in current if each != value.entry)
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


def resolve_configs(setup: TrackingSetup) -> dict[Mode, MpcConfig]:
    """Resolve the parameters of both modes: preset, then setup's overrides, then ablation's.

    Raises:
        UnknownName: If a name in `setup` is unknown.
    """
    ablation = get_ablation(setup.ablation)
    configs = _resolve(setup, ablation.preset or setup.preset, ablation.mpc)
    if ablation.equal_compute:
        stock = _resolve(setup, setup.preset, {})
        for mode, config in configs.items():
            samples = compute_policy_steps(stock[mode]) / (config.horizon * config.control_hz)
            configs[mode] = dataclasses.replace(config, num_samples=max(1, round(samples)))
    return configs


def _resolve(setup: TrackingSetup, preset: str, last: Mapping[str, Any]) -> dict[Mode, MpcConfig]:
    made = build_configs(make_morphology(setup.robot), RetargeterConfig(preset=preset))
    return {
        mode: override_config(override_config(config, setup.overrides, mode), last, mode)
        for mode, config in made.items()
    }


def make_tuned_morphology(setup: TrackingSetup) -> Morphology:
    """Make the robot, with the parameters of `setup` as its own.

    Raises:
        UnknownName: If a name in it is unknown.
    """
    morphology = make_morphology(setup.robot)
    # Set on the instance, so that other robots of the class keep their parameters.
    vars(morphology)["mpc_config"] = resolve_configs(setup).__getitem__
    return morphology


def make_retargeter_config(setup: TrackingSetup, seed: int) -> RetargeterConfig:
    """Make the settings of the retargeter: one thread, and those of the ablation.

    The preset stays the default: `make_tuned_morphology` has already applied the setup's.

    Raises:
        UnknownName: If the ablation sets a field that the retargeter does not have.
    """
    settings: dict[str, Any] = {"threads": 1, "seed": seed, "sync": setup.sync}
    settings |= dict(get_ablation(setup.ablation).retargeter)
    known = [each.name for each in dataclasses.fields(RetargeterConfig)]
    for name in settings:
        if name not in known:
            raise UnknownName("setting of RetargeterConfig", name, known)
    return RetargeterConfig(**settings)


def compute_policy_steps(config: MpcConfig) -> float:
    """Compute the low-level control steps rolled out per second of the robot's clock [1/s]."""
    return config.num_samples * config.horizon * config.control_hz


def compute_physics_steps(config: MpcConfig, time_step: float) -> float:
    """Compute the physics steps rolled out per second of the robot's clock [1/s]."""
    return compute_policy_steps(config) * round(POLICY_DT / time_step)


def parse_overrides(settings: Sequence[str]) -> dict[str, Any]:
    """Parse settings ``name=value``, the values as YAML.

    Raises:
        BadValue: If a setting is malformed.
    """
    pairs = (split_pair(setting, "a setting reads name=value") for setting in settings)
    return {name: load_yaml(value, switches=True) for name, value in pairs}
