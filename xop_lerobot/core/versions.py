"""Versions of the packages that a recording depends on."""

from __future__ import annotations

import importlib.metadata
import json
from functools import cache

_PACKAGES = ("lerobot_teleoperator_xop", "lerobot", "mujoco", "mink", "numpy", "onnxruntime")


@cache
def read_versions() -> str:
    """Versions of the packages that determine a recording, as a JSON object."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return json.dumps(versions)
