"""Arms that follow the wrists: inverse kinematics, and what they do in contact."""
