"""What the stiff, the extreme and the broken do to physics, chip, wire and learning."""
