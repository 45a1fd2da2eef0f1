"""The effects: each file holds all that anyone needs to know of one difference between ideal and real robots."""
