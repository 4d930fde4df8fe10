"""How well the chips' noise lets one sensor be read, beside how well a network reads it (paper section 4)."""
