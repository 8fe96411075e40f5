"""What a person does first, badly: strange arms, then letting go. The robot stands."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.test_teleoperation import OPEN, Person, Rig, robots
from xop_lerobot.core.transforms import make_pose, quat_from_rpy
from xop_lerobot.evaluation.trial import closed_loop
from xop_lerobot.morphology.morphology import make_morphology
from xop_lerobot.operator.devices import DEVICES, DeviceConfig
from xop_lerobot.operator.frame import OperatorFrame
from xop_lerobot.plant.config import SimulationConfig
from xop_lerobot.plant.simulation import Simulation
from xop_lerobot.retarget.config import RetargeterConfig
from xop_lerobot.session import Tick
from xop_lerobot.teleoperation import TeleoperationConfig

pytestmark = pytest.mark.slow

HEAD = np.array([0.0, 0.0, 1.7])
REST = (0.3, 0.2, -0.5)
LET_GO_S = 8.0
"""Long enough to see it: a policy that walks off has gone a metre by then [s]."""
POSTURES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    # where the left wrist is from the head [m], and its roll, pitch, yaw [rad]
    "palms up": (REST, (-np.pi, 0, 0)),
    "behind the back": ((-0.2, 0.15, -0.65), (-0.5, 0, 2.0)),
    "overhead": ((0.1, 0.2, 0.45), (0, -1.5, 0)),
    "crossed": ((0.3, -0.2, -0.45), (-1.0, 0, -0.5)),
}


@pytest.fixture(autouse=True)
def person() -> Iterator[None]:
    DEVICES.add("person", Person)
    yield
    DEVICES.remove("person")


def make_person(t: float, posture: str, share: float, *, seen: bool = True) -> OperatorFrame:
    """A person on the way from rest (`share` 0) to a posture (1), the arms mirrored."""
    place, rpy = POSTURES[posture]
    wrists = []
    for side in (1, -1):
        at = np.array(REST) + share * (np.array(place) - REST)
        roll, pitch, yaw = share * np.array(rpy)
        turn = quat_from_rpy(side * roll, pitch, side * yaw)
        wrists.append(make_pose(HEAD + at * [1, side, 1], turn))
    tracked = np.array([seen, True, True])
    head = make_pose(HEAD, np.array([1.0, 0, 0, 0]))
    return OperatorFrame(t, head, *wrists, pinch=OPEN, tracked=tracked)


@pytest.mark.parametrize("posture", list(POSTURES))
@robots
def test_a_robot_that_is_let_go_stands_whatever_its_arms_do(name: str, posture: str) -> None:
    """It stays within 0.1 m, and can be engaged again."""
    rig = Rig(name, retargeter=RetargeterConfig(type="direct"), mode="stationary")
    start = rig.loop.state.time

    def motion(t: float) -> OperatorFrame:
        t -= start
        let_go = 4.0 <= t < 4.0 + LET_GO_S
        return make_person(t, posture, float(np.clip((t - 1) / 1.5, 0, 1)), seen=not let_go)

    rig.person.motion = motion
    rig.run(1.0)
    assert rig.teleop.alignment.is_engaged
    arms, place = rig.loop.state.arms, rig.loop.state.true_qpos[:2]
    rig.run(3.0)
    assert np.abs(rig.loop.state.arms - arms).max() > 0.3
    ticks = rig.run(LET_GO_S)
    assert not ticks[-2][1].engaged
    assert np.linalg.norm(rig.loop.state.true_qpos[:2] - place) < 0.1
    assert not any(record.state.trouble or record.state.fallen for _, record in ticks)
    rig.run(0.5)
    assert rig.teleop.alignment.is_engaged


RECORDING = (
    Path(os.environ.get("XOP_SHARED", Path(__file__).parents[2] / "shared"))
    / "operator"
    / "human_seq_1_0.npz"
)


@pytest.mark.skipif(not RECORDING.exists(), reason="the recordings of people are not there")
@pytest.mark.parametrize("seed", [0, 6, 9])
def test_behind_a_person_who_turns_round_at_speed_the_torso_does_not_fold(seed):
    """With these seeds it did, where bending was cheap: the chest fell back behind the base."""
    plant = Simulation(make_morphology("rby1"), SimulationConfig(seed=0))
    device = DeviceConfig(type="replay", path=str(RECORDING), mode="mobile")
    retargeter = RetargeterConfig(threads=1, seed=seed)
    config = TeleoperationConfig(device=device, retargeter=retargeter)
    with closed_loop(plant, config) as (loop, teleoperation):
        teleoperation.connect()
        loop.reset(0)
        teleoperation.reset()
        lowest, engaged = np.inf, []
        for _ in range(200):
            action, tick = teleoperation.step(Tick(loop.state))
            engaged.append(tick.engaged)
            loop.execute(action, teleoperation.dt)
            lowest = min(lowest, float(plant.data.site("head").xpos[2]))
    assert engaged[-1]
    assert not loop.state.fallen
    assert lowest > 1.1
