"""Settings of the whole suite."""

from hypothesis import settings

# The machine's load is not a property of the code: no example fails for being slow.
settings.register_profile("project", deadline=None, print_blob=True)
settings.load_profile("project")
