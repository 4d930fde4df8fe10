"""From bytes and other people's files to readings, with every byte and row accounted for. Knows no model."""
