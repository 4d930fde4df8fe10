"""Each law of the simulator against a reference that shares no code with it."""
