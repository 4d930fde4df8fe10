"""The universal model: a physical law of skins, a map and networks made from it, and their calibration to one skin."""
