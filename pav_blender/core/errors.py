"""The two kinds of error that reach a user as one line."""

_LONGEST = 1000  # characters: some messages quote what a file holds, which may be anything


class PavError(Exception):
    """Work that failed: the message says what was found, where, and what to do. Exit code 1."""

    def __init__(self, message: str = "") -> None:
        if len(message) > _LONGEST:
            message = f"{message[: _LONGEST * 3 // 4]} ... {message[-_LONGEST // 5 :]}"
        super().__init__(message)


class InputError(PavError):
    """Wrong input from the user (a file, a name, a value). Exit code 2."""


class OtherPerson(InputError):
    """A track of another person than the avatar's, which may be meant."""


class Cancelled(PavError):
    """The user stopped the work; nothing is written under the final name."""
