"""Types and utilities shared by all packages; it imports none of them."""
