"""What jaxfit raises: one family, so that callers can catch everything of ours and nothing else."""


class JaxfitError(Exception):
    """Base of all errors raised on purpose; the message says what was expected, what came and what to do."""


class InputError(JaxfitError, ValueError):
    """A wrong argument: nothing was done."""


class ImageError(JaxfitError):
    """One picture cannot be read or used; batches report it and go on."""


class DatasetError(JaxfitError):
    """A dataset's folder, annotation file or database is missing, empty or malformed."""


class ProcessError(JaxfitError):
    """Another of the processes that work together ended or cannot be reached, or this one was forked."""


class ModelError(JaxfitError):
    """A model file is missing, damaged, or of a version this release does not read."""
