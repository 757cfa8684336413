"""What can go wrong in a way that a person can mend: the message is one line and says what was seen and what works."""


class HasrlError(Exception):
    """The base of all; the programs show its message without a traceback and end with its status."""

    exit_status = 1


class ConfigError(HasrlError, ValueError):
    """A configuration value that cannot work; the message names the field, the value and what would work."""

    exit_status = 2


class RunError(HasrlError, RuntimeError):
    """A run directory cannot be used; the message names the path."""


class CheckpointError(HasrlError, RuntimeError):
    """A checkpoint or policy file cannot be written or read; the message names the path."""


class WorkerError(HasrlError, RuntimeError):
    """Workers cannot be started or keep failing; the message carries the cause."""


class LearnerError(HasrlError, RuntimeError):
    """The update failed on its device; the message carries the cause."""


class DivergenceError(HasrlError, FloatingPointError):
    """An action, a simulation or a parameter is not finite any more."""
