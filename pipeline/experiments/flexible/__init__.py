"""Networks of rigid boards on flexible ones (paper section 5)."""
