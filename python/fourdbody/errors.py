# SPDX-License-Identifier: MIT OR Apache-2.0
"""The exception of this package."""


class Error(Exception):
    """What was expected, what was found, what to do.

    `code` is the exit code of the command line: 1 any other failure, 2 a mistake of the caller, 3 data loss that is
    accounted for, 4 damaged data or a failed verification.
    """

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code
        """The exit code that the command line would have."""
