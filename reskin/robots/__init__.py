"""Interfaces to the software that robots run: LeRobot datasets and sensors."""
