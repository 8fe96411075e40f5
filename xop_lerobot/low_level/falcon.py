"""FALCON's released network for the G1 with 29 joints (see NOTICE)."""

from __future__ import annotations

import numpy as np

from xop_lerobot.errors import PolicyFileError
from xop_lerobot.low_level.falcon_observation import (
    NUM_JOINTS,
    OBSERVATION_SIZE,
    FalconLikePolicy,
    calm_arms,
)
from xop_lerobot.low_level.networks import OnnxNetwork
from xop_lerobot.low_level.policy import POLICIES
from xop_lerobot.low_level.policy_file import find_falcon_file


class Falcon(FalconLikePolicy):
    """FALCON (Zhang et al., 2025): two networks, for legs and waist and for the arms' residual.

    It is shown calm arms (`calm_arms`), without which it walks off, or falls, in most postures
    at the ends of the arms' ranges.

    Args:
        path: Its ONNX file; None for the cached or downloaded one.

    Raises:
        PolicyFileError: If the file is missing, altered, no ONNX or of the wrong shape.
    """

    name = "falcon"

    def __init__(self, path: str | None = None) -> None:
        import onnx  # noqa: PLC0415
        from google.protobuf.message import DecodeError  # noqa: PLC0415

        file = find_falcon_file(path)
        try:
            model = onnx.load(str(file))
        except DecodeError as error:
            raise PolicyFileError(f"policy file '{file}' is not an ONNX model") from error
        self._network = OnnxNetwork(model, OBSERVATION_SIZE, NUM_JOINTS, str(file))

    def infer(self, observation: np.ndarray) -> np.ndarray:
        """Run the network; see `FalconLikePolicy.infer`."""
        return self._network(calm_arms(observation))


POLICIES.add("falcon", Falcon)
