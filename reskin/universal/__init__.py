"""The universal model, which estimates places and forces on skins for which it was not trained.

The model is a network that reads what is known of a skin (its no-load field, presses, labels), then estimates places
and forces of readings. It is trained on simulated skins (`population`, `episodes`, `training`, `making`).
"""
