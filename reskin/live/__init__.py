"""Boards while they run: contacts, alarms, the page of `reskin live`, recording, and emulated boards."""
