"""The universal model: a physical law of skins, a map and networks made with it, and their calibration to one skin."""
