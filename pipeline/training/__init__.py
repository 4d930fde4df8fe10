"""Train models for one scene: make training jobs from the scene's data, run them, and write the trained models.

Further modules contain the studies that use these models, such as adaptation with few labels.
"""

BEFORE_CONTACT_FILE = "before_touch.parquet"  # output of train_single: scores of places predicted before the contact
