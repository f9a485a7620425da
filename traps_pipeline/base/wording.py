"""Write counts and shares in words, the same way in every command and page."""


def count_noun(count: int, singular: str, plural: str | None = None) -> str:
    """Return a count with its noun: `1 family`, `2,340 scenarios`. plural: default, the singular with an s."""
    return f"{count:,} {singular if count == 1 else plural or f'{singular}s'}"


def in_percent(share: float, digits: int = 0) -> str:
    """Return a share (0 to 1) in percent, as `60 %`."""
    return f"{100 * share:.{digits}f} %"
