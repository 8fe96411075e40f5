"""Models of the planner: command model, kinematics, kinematic proposal and observers."""
