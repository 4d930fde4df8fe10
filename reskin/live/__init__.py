"""Work with running boards: contacts, alarms, the page of `reskin live`, recording, and emulated boards."""
