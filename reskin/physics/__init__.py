"""The synthetic skin: SI inside, uT at the border (`sensor`). Knows nothing of files, wires or learning."""
