"""Arm control: wrist goals, inverse kinematics, and behaviour in contact."""
