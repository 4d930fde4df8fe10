"""From predictions to scores and their statistics. Knows no network and no picture."""
