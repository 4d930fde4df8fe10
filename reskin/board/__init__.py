"""Boards: bytes on the wire, ports and faulty readings."""
