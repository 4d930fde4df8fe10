"""Networks and classical methods that estimate the place and the force of a contact, and the training of these methods.

Each estimate is made from a single reading of the field.
"""
