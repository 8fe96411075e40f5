"""Changes from outside the process: a local socket, its client, and keys of the terminal."""
