"""Findings of checks of data."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A probable fault of the data.

    Attributes:
        fault: Short name, such as "order of the quaternion".
        text: Description of the fault, with its size.
        mend: Correction of the data, an option or a line of numpy; empty if unknown.
        read: Score of the data as read; None without a comparison.
        fits: Score under the convention that fits.
        score: Meaning and unit of both scores.

    Example:
        >>> str(Finding("unit of levels", "levels are positive", "levels = 10 * np.log10(levels)"))
        'levels are positive; levels = 10 * np.log10(levels)'
    """

    fault: str
    text: str
    mend: str = ""
    read: float | None = None
    fits: float | None = None
    score: str = ""

    def __str__(self) -> str:
        return f"{self.text}; {self.mend}" if self.mend else self.text
