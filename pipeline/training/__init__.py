"""Train models for one scene: make training jobs from the scene's data, run them, and write the trained models.

Further modules contain the studies that use these models, such as adaptation with few labels.
"""
