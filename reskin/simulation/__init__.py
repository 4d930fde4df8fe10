"""Simulation of captures from a protocol, a rig and the physics of a skin, in the file formats of recorded captures."""
