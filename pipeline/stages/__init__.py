"""Stages of dvc.yaml: each reads its inputs, calls the library or an experiment, and writes its outputs."""
