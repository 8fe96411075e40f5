"""State synchronisation (Eq. 4): a contact-consistent state of noisy sensors."""
