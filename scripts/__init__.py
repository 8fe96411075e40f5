"""Development scripts: set-up, demo, training of G1's policy; not part of the installed package."""
