"""Low-level policies: from a command to motor targets, batched, behind one interface."""
