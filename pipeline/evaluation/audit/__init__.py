"""Whether test rows leaked into training: folds, copies, scalers, settings. Knows no model, page and stage."""
