"""From captures to rows that a model may see: joining clocks, no-load policies, splits. Knows no network."""
