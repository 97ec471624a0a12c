"""The one exception that means: the user's input is wrong, and here is how to fix it."""


class InputError(ValueError):
    """The user's input cannot be used.

    The text is one line that says where it stands (file and line, or the override), which field, what was expected,
    what came, and how to fix it. The command line prints it without a traceback and leaves with status 2.

    Attributes:
        option: The argument that is wrong, such as ``out``, where the text begins with its name or holds it before a
            colon; the command line writes it as it is typed, ``--out``.
    """

    def __init__(self, text: str, *, option: str | None = None) -> None:
        """The error, with the argument that is wrong where there is one."""
        super().__init__(text)
        self.option = option


class OptionError(InputError):
    """The value of one option turns out not to fit once it is used; its text begins with the option's name.

    Attributes:
        option: The option's dotted name, such as ``rig.cameras``. Who knows where its value stands, adds that.
    """

    def __init__(self, option: str, text: str) -> None:
        """The error; ``text`` says what was expected, what came, and how to fix it."""
        super().__init__(f"{option}: {text}", option=option)
