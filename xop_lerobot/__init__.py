"""Whole-body XR teleoperation by MPC retargeting, recorded by LeRobot."""

__version__ = "0.1.0"
