"""Reference trajectory over the horizon, and desired heading of a wheeled base."""
