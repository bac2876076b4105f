"""The one exception for what a user can mend."""


class InputError(ValueError):
    """Bad input. The message is one sentence that names the file or key at fault and says what to do.

    Entry points print it without a traceback and exit with status 2.
    """
