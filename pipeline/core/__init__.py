"""What every stage stands on: errors, files, tables, seeds, settings, costs. Knows no skin."""
