"""Tables, figures and pages of a scene, made from its scores and numbers; no module here uses models."""
