"""A skin over its contacts, by no-load policy (paper section 4, figure 5)."""
