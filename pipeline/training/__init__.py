"""Training for one scene: jobs from the scene's rows and folds, models with cards, studies that use these models."""

BEFORE_CONTACT_FILE = "before_touch.parquet"  # output of train_single: scores of places predicted before the contact
