"""Camera images as JPEG, encoded on a separate thread; only the latest are encoded."""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image

logger = logging.getLogger(__name__)

QUALITY = 70
"""JPEG quality, of 100."""
MAX_SIDE = 1280
"""Longest side of a transmitted image; larger images are scaled down [px]."""
MAX_CAMERAS = 4
FIRST = "head"
"""Camera shown first."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Images of all cameras at one instant.

    Attributes:
        messages: A message per camera: its index in one byte, then the JPEG.
    """

    messages: tuple[bytes, ...]


class PictureEncoder:
    """Encodes the latest images; older ones are skipped."""

    def __init__(self) -> None:
        self.newest: Picture | None = None
        """Latest encoded images."""
        self._given: Mapping[str, np.ndarray] | None = None
        self._wake = threading.Condition()
        self._running = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread."""
        self._running = True
        self._thread = threading.Thread(target=self._run, name="xop-pictures", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; may be called twice."""
        with self._wake:
            self._running = False
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            self._thread = None

    def give(self, pictures: Mapping[str, np.ndarray]) -> None:
        """Provide images by camera, which must not be modified afterwards; returns at once."""
        with self._wake:
            self._given = pictures
            self._wake.notify()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._given is not None or not self._running)
                if not self._running:
                    return
                given, self._given = self._given, None
            try:
                self.newest = encode(given or {})
            except (OSError, ValueError, TypeError):
                logger.exception("a camera's image cannot be encoded")


def encode(pictures: Mapping[str, np.ndarray]) -> Picture:
    """Encode the images of the cameras, the head camera first.

    Args:
        pictures: Images by camera. Shapes (height, width, 3), uint8.
    """
    names = sorted(pictures, key=lambda name: (name != FIRST, name))[:MAX_CAMERAS]
    messages = []
    for number, name in enumerate(names):
        image = Image.fromarray(pictures[name])
        image.thumbnail((MAX_SIDE, MAX_SIDE))
        data = io.BytesIO()
        image.save(data, "JPEG", quality=QUALITY)
        messages.append(bytes([number]) + data.getvalue())
    return Picture(tuple(messages))
