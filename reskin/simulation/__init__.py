"""Simulated captures: a protocol, a rig and the physics of a skin give the files of a recorded capture."""
