"""Two contacts at once (paper section 7)."""
