"""Force and place from an SD card's log (paper section 6)."""
