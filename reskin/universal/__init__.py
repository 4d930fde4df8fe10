"""The universal model, which estimates places and forces on skins for which it was not trained.

The model consists of a map, which is based on a physical law of skins, and of networks. Both are calibrated to one
skin.
"""
