"""From scores to tables, figures and pages. Sees tables, never models."""
