"""Axes of the headsets' world, the same for ARKit and WebXR."""

from __future__ import annotations

import numpy as np

# Theirs is x right, y up, z back; the operator's world is X forward, Y left, Z up.
WORLD = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Turns a headset's coordinates into ours. Shape (3, 3)."""
WORLD.setflags(write=False)
