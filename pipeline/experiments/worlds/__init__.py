"""What decides table 2: its rows against what simulated skins differ in."""
