"""Low-level policies: batched controllers from commands to motor targets, behind one interface."""
