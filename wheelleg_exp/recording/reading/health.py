"""How whole a recording's file is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Damage:
    """A message that cannot be read.

    Attributes:
        begin, end: where it stands in the file, bytes.
        reason: what is wrong with it.
    """

    begin: int
    end: int
    reason: str


@dataclass(frozen=True)
class Health:
    """How whole a recording's file is.

    Attributes:
        size: bytes of the file.
        readable: bytes from its beginning to the end of the last whole message.
        messages: how many whole messages there are.
        is_closed: whether its writer closed it, which leaves an index at its end.
        damaged: messages that are left out because they cannot be read.
        writer: version of rerun that wrote it.
    """

    size: int
    readable: int
    messages: int
    is_closed: bool
    damaged: tuple[Damage, ...]
    writer: str

    @property
    def is_whole(self) -> bool:
        """Whether nothing is missing and nothing damaged."""
        return self.is_closed and not self.damaged

    @property
    def lost(self) -> int:
        """Bytes of the file that hold nothing that can be read."""
        return self.size - self.readable + sum(damage.end - damage.begin for damage in self.damaged)

    def lines(self) -> list[str]:
        """Return sentences for people, the verdict first."""
        return ["whole" if self.is_whole else "not whole", *self._troubles()]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as a plain mapping."""
        return {"is_whole": self.is_whole, **asdict(self), "lost": self.lost}

    def _troubles(self) -> Iterator[str]:
        if self.readable < self.size:
            yield f"cut off at byte {self.readable} of {self.size}: what follows is no whole message"
        elif not self.is_closed:
            yield "not closed: it is still being written, or its writer was killed"
        for damage in self.damaged[:3]:
            yield f"damaged from byte {damage.begin} to {damage.end}: {damage.reason}"
        if len(self.damaged) > 3:
            yield f"{len(self.damaged) - 3} more damaged messages"
