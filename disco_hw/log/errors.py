"""What can be wrong with a log, in one line for the user."""

from disco_hw.errors import InputError


class LogError(InputError):
    """A log cannot be made, read or mended; the message is one line: file, what is wrong, what to do."""
