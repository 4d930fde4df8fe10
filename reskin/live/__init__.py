"""Running boards: contacts, alarms, the page of `reskin live`, recording, and emulated boards."""
