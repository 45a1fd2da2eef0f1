"""The verbs of the command line, called in this process."""

from typer.testing import CliRunner

from disco_hw.cli import app


def call(*arguments):
    """Return what a verb prints that ends well."""
    done = CliRunner().invoke(app(), [*map(str, arguments)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout
