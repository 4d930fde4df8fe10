"""The universal model: a physical law of skins, a map and networks based on it, and calibration of both to one skin."""
