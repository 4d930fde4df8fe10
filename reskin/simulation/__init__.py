"""Captures of skins that do not exist: a plan, a rig and physics -> what a port and a probe would have written.

Refuses to know who reads them.
"""
