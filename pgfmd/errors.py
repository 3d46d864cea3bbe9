"""The exceptions that a user is meant to read: one clear line each."""


class InputError(ValueError):
    """A wrong input: the message says what is wrong, where, and what is allowed.  The command line exits with 2."""


class SolverError(RuntimeError):
    """A solver could not certify its answer; the message says why.  The command line exits with 3."""


class Uncertifiable(SolverError):
    """An error that rounding alone keeps above the tolerance: no other method could certify less."""


class Unreachable(SolverError):
    """A target that no load gives, such as an area below that of first contact; other targets may be fine."""


class Stopped(Exception):
    """A run was asked to stop, and did, ready to be continued; the message says by whom.

    The command line exits with 75 (EX_TEMPFAIL).
    """


class NoProgress(Exception):
    """A time limit ended a run before its first new checkpoint, as it would each time.

    The command line exits with 1.
    """
