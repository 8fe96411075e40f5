"""Axes of headset coordinates, the same for ARKit and WebXR."""

from __future__ import annotations

import numpy as np

# Headset: x right, y up, z back. Operator's world: X forward, Y left, Z up.
WORLD = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Rotation from headset coordinates to the operator's world. Shape (3, 3)."""
WORLD.setflags(write=False)
