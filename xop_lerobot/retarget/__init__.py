"""From an operator's goal to a robot's command: the model predictive controller and its parts."""
