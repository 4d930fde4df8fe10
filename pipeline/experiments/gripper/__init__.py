"""A gripper that holds a force by our estimate of it."""
