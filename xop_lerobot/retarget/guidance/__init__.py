"""Reference trajectory over the horizon, and where a base on wheels shall face."""
