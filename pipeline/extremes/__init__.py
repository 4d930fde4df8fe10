"""Extreme cases that judge learning by evaluation's measures, two that know nothing of each other. Knows no page."""
