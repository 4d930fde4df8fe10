"""Is the simulator right? Each law against a reference that shares no code with it. Knows no page and no stage."""
