"""Presets: named sets of planner parameters, one of them our implementation of the paper's."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

from xop_lerobot.core.command import Mode
from xop_lerobot.morphology.morphology import Morphology
from xop_lerobot.morphology.tuning import CostWeights, MpcConfig, PaperParameters
from xop_lerobot.retarget.changes import Settings, make_settings
from xop_lerobot.retarget.config import PRESETS, RetargeterConfig

_UNLIMITED = 1e6  # reach that no goal exceeds: goals are not held near [m]
_PAPER_WEIGHTS = CostWeights(
    position=1.0,
    orientation=1.0,
    tilt_share=1.0,
    stance=0.1,
    collision=1.0,
    collision_velocity=1.0,
    collision_decay=1.0,
    collision_velocity_decay=10.0,
    collision_range=math.inf,
    upright=1.0,
    control=0.1,
    change=0.0,
    terminal=1.0,  # the paper does not give w_f
    fall=0.0,
    support=0.0,
    lean=0.0,
    load=0.0,
    lateral=0.0,
)


def _keep(morphology: Morphology, config: MpcConfig, paper: PaperParameters) -> MpcConfig:
    """Keep the robot's own parameters."""
    del morphology, paper
    return config


def _make_conservative(
    morphology: Morphology, config: MpcConfig, paper: PaperParameters
) -> MpcConfig:
    """Smoother and slower motion; plays the role of the paper's w_a = 0.5.

    The paper's control energy weighs the absolute command, which would pull a standing height
    down. Here changes of the command cost instead, the proposal is slower, the samples stay closer
    to the plan, and it is the mean of more of them: with few, a costly change comes in jerks.
    """
    del morphology, paper
    weights = dataclasses.replace(config.weights, control=0.5, change=0.8)
    many = 2.5 * config.effective_samples
    config = dataclasses.replace(config, weights=weights, effective_samples=many)
    return _scale_pace(config, time=2.0, noise=0.3)


def _make_aggressive(
    morphology: Morphology, config: MpcConfig, paper: PaperParameters
) -> MpcConfig:
    """Faster and rougher motion; plays the role of the paper's w_a = 0.02."""
    del morphology, paper
    weights = dataclasses.replace(config.weights, control=0.02, change=0.0)
    faster = _scale_pace(dataclasses.replace(config, weights=weights), time=0.7, noise=1.5)
    return dataclasses.replace(faster, full_noise_error=0.5 * config.full_noise_error)


def _scale_pace(config: MpcConfig, time: float, noise: float) -> MpcConfig:
    """Scale the lead time of the proposal and the standard deviation of the samples."""
    noise_std = {name: noise * value for name, value in config.noise_std.items()}
    return dataclasses.replace(config, proposal_s=time * config.proposal_s, noise_std=noise_std)


def _make_table1(morphology: Morphology, config: MpcConfig, paper: PaperParameters) -> MpcConfig:
    r"""The paper's Table I and Eqs. 1 and 3 by their letter; the authors' code is not public.

    The control energy is :math:`w_a\|a\|^2` of the command itself, in its own units. What the table
    leaves open follows KMPPI of pytorch_mppi, which the paper names: half as many support points
    as steps, a zero-mean kernel one step wide, a shift by one step, raw weights, and the
    importance-sampling term. There is nothing of ours: no fixed candidates, preview, extrapolation,
    limit of the goal, or aid (`MpcConfig.aids`).

    The paper's running costs are sums over the H steps, ours are means. Its weights are those of
    the means at :math:`\lambda / H` and :math:`w_f / H`.
    """
    joints = [joint for arm in morphology.arms for joint in arm.joints]
    # The paper's commands have no neck.
    body = [dim.name for dim in morphology.command_space.dims if not dim.alone]
    entries = (*body, *joints)
    return dataclasses.replace(
        config,
        optimizer="kmppi",
        num_samples=paper.num_samples,
        horizon=paper.horizon,
        noise_std=dict.fromkeys(entries, paper.noise_std),
        control_hz=paper.control_hz,
        num_knots=max(1, paper.horizon // 2),
        kernel_width=1.0,
        kernel_mean="zero",
        shift="one",
        sampling="gaussian",
        sample_plan=False,
        weighting="raw",
        temperature=0.001 / paper.horizon,
        importance_cost=True,
        min_noise=1.0,
        preview_s=0.0,
        extrapolation_s=0.0,
        candidates=(),
        control_reference="zero",
        scale_control=False,
        aids=(),
        reach=_UNLIMITED,
        weights=dataclasses.replace(
            _PAPER_WEIGHTS, terminal=_PAPER_WEIGHTS.terminal / paper.horizon
        ),
    )


def _make_table1_charitable(
    morphology: Morphology, config: MpcConfig, paper: PaperParameters
) -> MpcConfig:
    """The reading of Table I that moves the robots best.

    Its numbers are those of `table1`. Where the paper is silent it departs from KMPPI of
    pytorch_mppi: the kernel holds a command instead of letting it decay, the plan is shifted by the
    elapsed time, is a sample itself, and pays no importance-sampling term. And the control energy
    counts from the command at rest, so that standing upright costs nothing.
    """
    return dataclasses.replace(
        _make_table1(morphology, config, paper),
        kernel_mean="hold",
        shift="measured",
        sample_plan=True,
        importance_cost=False,
        control_reference="neutral",
    )


_MAKERS: dict[str, Callable[[Morphology, MpcConfig, PaperParameters], MpcConfig]] = {
    "default": _keep,
    "conservative": _make_conservative,
    "aggressive": _make_aggressive,
    "table1": _make_table1,
    "table1_charitable": _make_table1_charitable,
}
assert tuple(_MAKERS) == PRESETS


def build_configs(
    morphology: Morphology, config: RetargeterConfig, settings: Settings | None = None
) -> dict[Mode, MpcConfig]:
    """Build the parameters of each mode: those of the preset, then manual overrides.

    Args:
        morphology: The robot.
        config: Settings of the session; zeros keep the preset's value.
        settings: Settings in force; by default the initial ones of `config`.
    """
    settings = settings or make_settings(morphology, config)
    variant = morphology.variants[settings.variant]
    configs = {}
    for mode in Mode:
        own = variant.configs.get(mode) or morphology.mpc_config(mode)
        made = _MAKERS[settings.preset](morphology, own, variant.paper[mode])
        weights = dataclasses.replace(made.weights, **settings.weights)
        configs[mode] = config.override(dataclasses.replace(made, weights=weights))
    return configs
