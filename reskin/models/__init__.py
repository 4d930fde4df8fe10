"""From rows to models: the network, the one training loop, the grid of recipes. Knows no path and no page."""
