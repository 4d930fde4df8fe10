"""How the field of equal pokes differs over time and skins (paper figure 4)."""
