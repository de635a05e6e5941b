"""Text that comes from files and shall steer nothing that shows it. The standard library only."""

import re

# But line ends and tabs; what turns the direction of writing or is invisible; bytes of file names that are no text.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")


def visible(text: str) -> str:
    """`text` with control characters spelt out: names from files shall not steer a terminal, nor turn a page's words round."""
    return _CONTROL.sub(lambda found: ascii(found.group())[1:-1], text)
