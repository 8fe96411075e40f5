"""Play a scripted person: waypoints with minimum jerk, postural sway and tremor."""

from __future__ import annotations

from xop_lerobot.core.errors import NotConnected
from xop_lerobot.core.transforms import level_pose, pose_multiply
from xop_lerobot.operator.devices.config import DeviceConfig
from xop_lerobot.operator.devices.replay import Player
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.operator.noise import HumanNoise
from xop_lerobot.operator.script import Script, load_script

DEFAULT_SCRIPT = "g1_squat_walk_reach"


class ScriptedDevice(Player):
    """A person who follows a script; the same seed gives the same stream.

    Args:
        config: Its settings; without a `path` the script is `DEFAULT_SCRIPT`.
    """

    def __init__(self, config: DeviceConfig) -> None:
        super().__init__(config)
        self._noise = HumanNoise(config.seed, config.noise)
        self._script: Script | None = None

    def connect(self) -> None:
        """Read and check the script.

        Raises:
            BadScript: If it is missing or malformed.
        """
        self._script = load_script(self.config.path or DEFAULT_SCRIPT)

    @property
    def script(self) -> Script:
        """What is played.

        Raises:
            NotConnected: Before `connect()`.
        """
        if self._script is None:
            raise NotConnected("device 'scripted'")
        return self._script

    @property
    def duration(self) -> float:
        """Length of the script [s]."""
        return self.script.duration

    def frame_at(self, stamp: float) -> OperatorFrame:
        """Frame at `stamp` [s] of the script's clock; the sway continues after its end."""
        script = self.script
        head = script.tracks["head"].at(stamp)
        wrists = [script.tracks[name].at(stamp) for name in ("left_wrist", "right_wrist")]
        if script.wrists_in_body:
            body = level_pose(head)
            wrists = [pose_multiply(body, wrist) for wrist in wrists]
        mode = script.mode_at(stamp)
        return self._noise.disturb(
            OperatorFrame(
                stamp,
                head,
                *wrists,
                pinch=script.pinch_at(stamp),
                # A script that states modes states them from the beginning.
                mode=self.start_mode if mode is None and script.modes else mode,
            )
        )
