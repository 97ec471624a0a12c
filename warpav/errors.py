"""The one exception that means: the user's input is wrong, and here is how to mend it."""


class InputError(ValueError):
    """The user's input cannot be used.

    The text is one line that says where it stands (file and line, or the override), which field, what was expected,
    what came, and how to mend it. The command line prints it without a traceback and leaves with status 2.
    """
