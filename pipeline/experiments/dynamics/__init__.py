"""Presses that never rest (paper section 7)."""
