"""Changes of settings from outside: a local socket, its client, and keys of the terminal."""
