"""Results published in the paper: 10 trials per row, human operators with a real headset.

From its Tables II to IV. They are shown beside ours for orientation only: operators, rooms and
points differ, and its AMO and FALCON are the released networks.
"""

from __future__ import annotations

from dataclasses import dataclass

SIMULATION, REAL = "simulation", "real robot"


@dataclass(frozen=True)
class PublishedRow:
    """One row of the paper's tables, counts out of 10; None where the paper gives no value.

    Attributes:
        robot: Robot, by its name here.
        task: Task, by its name here.
        method: Method, by its name here.
        variant: Variant, by its name here.
        low_level: Low-level policy, by its name here.
        setting: Simulation or real robot.
        success: Successful trials (TSR, PPSR or DSR).
        pickup: Trials in which the box was picked up (PSR).
        collision: Trials with a collision (CR).
        ct: Completion time, mean and standard deviation [s].
        abp: Average balance power, mean and standard deviation [W].
        tilt: Tilt angle, mean and standard deviation [rad].
        jerk: Jerk, mean and standard deviation [m/s³].
    """

    robot: str
    task: str
    method: str
    variant: str
    low_level: str
    setting: str
    success: int
    pickup: int | None = None
    collision: int | None = None
    ct: tuple[float, float] | None = None
    abp: tuple[float, float] | None = None
    tilt: tuple[float, float] | None = None
    jerk: tuple[float, float] | None = None


def _humanoid(
    setting: str,
    method: str,
    policy: str,
    touch: tuple[int, float, float, float, float],
    box: tuple[int, int, float, float, float, float],
) -> tuple[PublishedRow, PublishedRow]:
    """One row of Table II."""
    ends = ("g1", "dual_point_touch"), ("g1", "box_pick_and_place")
    middle = (method, "", policy, setting)
    return (
        PublishedRow(*ends[0], *middle, touch[0], ct=touch[1:3], abp=touch[3:]),
        PublishedRow(*ends[1], *middle, box[1], pickup=box[0], ct=box[2:4], abp=box[4:]),
    )


def _manipulator(
    setting: str,
    method: str,
    touch: tuple[int, int, float, float],
    box: tuple[int, int, int, float, float],
) -> tuple[PublishedRow, PublishedRow]:
    """One row of Table III."""
    ends = ("rby1", "dual_point_touch"), ("rby1", "box_pick_and_place")
    middle = (method, "", "diff_drive", setting)
    return (
        PublishedRow(*ends[0], *middle, touch[0], collision=touch[1], ct=touch[2:]),
        PublishedRow(*ends[1], *middle, box[1], pickup=box[0], collision=box[2], ct=box[3:]),
    )


def _transport(
    variant: str,
    success: int,
    ct: tuple[float, float],
    tilt: tuple[float, float],
    jerk: tuple[float, float],
) -> PublishedRow:
    """One row of Table IV."""
    return PublishedRow(
        "rby1", "non_prehensile_transport", "mpc", variant, "diff_drive", REAL, success,
        ct=ct, tilt=tilt, jerk=jerk,
    )  # fmt: skip


PUBLISHED: tuple[PublishedRow, ...] = (
    *_humanoid(SIMULATION, "direct_amo", "amo", (10, 69.62, 38.36, 0.17, 0.07),
               (10, 1, 49.84, 0.0, 0.28, 0.05)),
    *_humanoid(SIMULATION, "direct", "falcon", (10, 38.30, 16.42, 0.24, 0.26),
               (8, 1, 78.16, 0.0, 0.57, 0.15)),
    *_humanoid(SIMULATION, "mpc_no_sync", "falcon", (10, 52.66, 31.44, 0.43, 0.09),
               (10, 10, 38.43, 8.32, 1.56, 0.04)),
    *_humanoid(SIMULATION, "mpc", "falcon", (10, 26.58, 6.60, 0.14, 0.06),
               (10, 10, 30.75, 7.99, 0.17, 0.05)),
    *_humanoid(REAL, "direct", "falcon", (6, 106.36, 35.10, 0.63, 0.06),
               (10, 5, 60.34, 18.55, 0.70, 0.11)),
    *_humanoid(REAL, "mpc", "falcon", (10, 55.83, 43.20, 0.38, 0.08),
               (10, 9, 41.95, 3.90, 0.39, 0.08)),
    *_manipulator(SIMULATION, "direct", (6, 4, 21.08, 8.89), (6, 1, 9, 109.28, 0.0)),
    *_manipulator(SIMULATION, "mpc", (10, 0, 26.49, 13.69), (10, 10, 0, 139.07, 4.32)),
    *_manipulator(REAL, "direct", (9, 1, 38.48, 10.76), (10, 1, 5, 95.73, 0.0)),
    *_manipulator(REAL, "mpc", (10, 0, 56.75, 19.14), (10, 7, 0, 116.5, 37.48)),
    _transport("v1", 1, (30.80, 0.0), (0.41, 0.12), (1259.51, 256.05)),
    _transport("v2_upright", 10, (34.50, 6.37), (0.03, 0.03), (1059.44, 191.45)),
    _transport("v2_upright_conservative", 7, (40.75, 1.06), (0.05, 0.03), (769.99, 11.02)),
    _transport("v2_upright_aggressive", 6, (24.50, 3.50), (0.01, 0.01), (2144.55, 87.80)),
)  # fmt: skip
"""All rows."""

PUBLISHED_TRIALS = 10


def find_published(robot: str, task: str, setting: str | None = None) -> list[PublishedRow]:
    """Return the paper's rows for a task of a robot, in its order."""
    return [
        row
        for row in PUBLISHED
        if row.robot == robot and row.task == task and setting in (None, row.setting)
    ]
