"""What a user can mend, said in one sentence."""

EXIT_PARTIAL = 3
"""Exit code of a command that finished but left something out (a broken photo, say)."""


class InputError(Exception):
    """Something in the input is wrong: the message says what, where, and how to mend it.

    The library raises it everywhere a user can cause the fault. Arguments stand in the message
    as `name`, in backticks; the command line shows its own option there.

    Attributes:
        message: the sentence.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message
