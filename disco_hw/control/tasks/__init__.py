"""The tasks: small objects with a cost, a terminal cost and a picture."""
