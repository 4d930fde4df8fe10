"""From predictions to scores. NumPy only: knows no network and no picture."""
