"""What the stiff, the extreme and the broken do to physics, chip and wire. Knows no page and no stage."""
