"""What a user can mend, said in one sentence."""

import click

EXIT_PARTIAL = 3
"""Exit code of a command that finished but left something out (a broken photo, say)."""


class InputError(click.ClickException):
    """Something in the input is wrong: the message says what, where, and how to mend it.

    The library raises it everywhere a user can cause the fault; click prints it without a
    traceback and exits with code 1.
    """
