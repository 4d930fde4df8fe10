"""Recordings: captures and files of other rigs, read into readings with an account of every lost byte and row."""
