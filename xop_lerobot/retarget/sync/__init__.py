"""State synchronisation (Eq. 4): a contact-consistent state from noisy sensors."""
