"""Recorded changes of field beside simulated ones, poke by poke."""
