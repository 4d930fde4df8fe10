"""What the physics leaves out, and what that costs."""
