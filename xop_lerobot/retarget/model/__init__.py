"""What the planner knows: command model, kinematics, proposal and observers."""
