"""What the operator's hands ask for: of the robot, and of the recording."""

from __future__ import annotations

from typing import NamedTuple

from xop_lerobot.operator.display import Wish
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.gestures import Gesture, GestureConfig, GestureReader
from xop_lerobot.operator.raised_hands import RaisedHands


class Asked(NamedTuple):
    """What the gestures that are complete with a frame ask for."""

    mode: bool = False
    """To toggle the mode."""
    toggle: str = ""
    """To toggle a constraint or a preset of this name; empty for none."""
    wishes: tuple[Wish, ...] = ()
    """What is asked of the recording."""


class Hands:
    """Reads all gestures but the clutch's, whether the operator drives or not.

    Args:
        config: What the gestures do.
        has_person: Whether somebody wears a headset now. Recordings and scripts replay as they
            were recorded, and say nothing about the recording that is made now.
    """

    def __init__(self, config: GestureConfig, *, has_person: bool) -> None:
        self._config, self._has_person = config, has_person
        self._pinches = GestureReader(config)
        self.raised = RaisedHands(config.raised)

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._pinches.reset()
        self.raised.reset()

    def read(self, frame: OperatorFrame | None) -> Asked:
        """Take the frame of a tick, None before the first."""
        wishes = []
        if self._has_person and (wish := self.raised.update(frame)) is not None:
            wishes.append(wish)
        pinched = None if frame is None else self._pinches.update(frame)
        both, other = self._config.both_double_pinch, self._config.other_double_pinch
        if pinched is Gesture.OTHER_DOUBLE_PINCH and self._has_person and other == "success":
            wishes.append(Wish.SUCCESS)
        toggles = pinched is Gesture.BOTH_DOUBLE_PINCH and both != "none"
        return Asked(pinched is Gesture.DOUBLE_PINCH, both if toggles else "", tuple(wishes))


def explain_gestures(config: GestureConfig) -> dict[str, str]:
    """Explain each gesture in a sentence, by what it does."""
    clutch, raised = config.clutch, config.raised
    palms = "turn both palms up, " if clutch.gesture == "palms_up" else ""
    first = config.double_pinch.hand
    other = "right" if first == "left" else "left"
    explained = {
        "engage": f"{palms}pinch with both hands, and hold still for {clutch.hold:g} s".capitalize()
        + "; the same lets go",
        "mode": f"Pinch twice with the {first} hand",
    }
    for name, length in (
        ("end", raised.hold), ("redo", raised.long_hold), ("stop", raised.long_hold)
    ):  # fmt: skip
        hands = getattr(raised, name)
        if hands != "none":
            which = "both hands, palms" if hands == "both" else f"the {hands} hand, palm"
            explained[name] = (
                f"Raise {which} away from you, pinch there, and hold still for {length:g} s"
            )
    if config.other_double_pinch == "success":
        explained["success"] = f"Pinch twice with the {other} hand"
    if config.both_double_pinch != "none":
        explained[config.both_double_pinch] = "Pinch twice with both hands at once"
    return explained
