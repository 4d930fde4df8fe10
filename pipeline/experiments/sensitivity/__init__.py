"""The smallest weight told apart (paper section 6)."""
