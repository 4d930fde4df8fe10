"""Networks and classical methods that estimate place and force from a single reading, and their training."""
