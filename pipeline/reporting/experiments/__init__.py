"""The experiments of the paper, a module each: answers -> tables and figures. Sees numbers, never data."""
