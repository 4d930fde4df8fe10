"""Networks adapted by hand pokes (paper section 5)."""
