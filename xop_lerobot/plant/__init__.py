"""Plants: the robot's body behind one interface, at present simulated ones."""
