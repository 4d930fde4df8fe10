"""Fields from outside, and iron nearby (paper section 7)."""
