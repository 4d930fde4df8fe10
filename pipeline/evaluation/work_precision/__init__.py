"""Error against run time, of the ways to sum a skin and to relax its force. Knows no file and no picture."""
