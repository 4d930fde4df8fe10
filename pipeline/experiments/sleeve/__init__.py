"""Many boards under one skin (paper section 6)."""
