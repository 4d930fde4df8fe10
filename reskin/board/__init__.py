"""Communication with boards: ports, the formats of the bytes that a board sends, frame rates, and faulty readings."""
