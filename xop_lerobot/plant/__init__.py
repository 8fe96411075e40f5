"""The body behind one interface: simulated now, real robots later."""
