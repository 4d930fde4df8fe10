"""Error against run time: ways to sum a skin and to relax its force."""
