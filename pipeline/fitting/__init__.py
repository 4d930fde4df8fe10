"""Recorded presses of a board: their axes and orientations, and the fit of the law of a skin to them."""
