"""Place and all three forces of dragged lines (paper section 4)."""
