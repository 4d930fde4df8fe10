"""Simulated captures, in the file formats of recorded ones, from a protocol, a rig and the physics of a skin."""
