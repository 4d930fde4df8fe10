"""Whether test rows leaked into training: folds, copies, scalers, settings."""
