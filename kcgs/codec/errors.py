"""What a damaged file raises."""


class CodecError(ValueError):
    """A stream that is damaged, or no stream of this format."""
