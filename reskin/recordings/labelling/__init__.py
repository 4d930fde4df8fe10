"""Where labels come from while a board is recorded: keys, a table that grows, a force gauge, a robot's program.

Refuses to know frames and fields: labels alone pass here.
"""
