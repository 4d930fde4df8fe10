"""Training for one scene: jobs from its rows and folds, models with cards, and studies that use these models."""

BEFORE_CONTACT_FILE = "before_touch.parquet"  # output of train_single: scores of places without the contact's signal
