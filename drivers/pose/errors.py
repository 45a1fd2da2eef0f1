"""What keeps a pose source from being had."""


class PoseSourceError(ValueError):
    """A source that cannot be had, by its name or its device; the message is one line with the remedy."""
