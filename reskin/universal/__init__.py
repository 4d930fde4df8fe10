"""Simulated twins of recorded boards: a law of a few numbers, fitted on pokes; and a map of what a skin would read.

Refuses to know scenes and files.
"""
