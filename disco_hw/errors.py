"""What a user did wrong, as opposed to what failed."""


class InputError(Exception):
    """Bad input: the message is one line that names the file, the field and the remedy; commands exit with 2."""


class WorkError(Exception):
    """The work itself failed: the message is one line that says what and why; commands exit with 1."""


class LogError(InputError):
    """A log cannot be made, read or mended; the message is one line: file, what is wrong, what to do."""
