"""Commands that manage recordings and results in a checkout."""
