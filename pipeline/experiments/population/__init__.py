"""Experts taught simulated skins only, on skins of a simulated scene: unlabelled pokes, one weight, a few labels."""
