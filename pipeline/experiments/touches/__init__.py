"""Touches at numbered places, one or two at once, recorded (paper section 7)."""
