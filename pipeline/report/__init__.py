"""Tables, figures and pages, made from the scores and numbers of a scene; nothing here uses models."""
