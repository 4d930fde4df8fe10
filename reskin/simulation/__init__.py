"""Simulated captures: files as of a recorded capture, from a protocol, a rig and the physics of a skin."""
