"""Networks and classical methods that estimate place and force from one reading: recipes, losses and training."""
