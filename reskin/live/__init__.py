"""A board at work: ports, contacts while they happen, a page, and boards that are not there. Refuses to train."""
