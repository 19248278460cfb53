"""The words of a command line before tyro reads them."""

_QUIET = ("-q", "--quiet")


def options_in(words: list[str]) -> list[str]:
    """The words among which there are options: those after a "--" are none."""
    return words[: words.index("--")] if "--" in words else words


def take_quiet(words: list[str]) -> tuple[list[str], bool]:
    """The words without `-q`, which every command has; and whether it was there."""
    options = options_in(words)
    kept = [word for word in options if word not in _QUIET]
    return kept + words[len(options) :], len(kept) < len(options)
