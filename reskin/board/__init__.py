"""Boards: wire formats, ports and faulty readings."""
