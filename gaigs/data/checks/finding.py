"""What a check finds in data."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A fault that data probably have.

    Attributes:
        fault: Short name, such as "order of the quaternion".
        text: What was found, and by how much.
        mend: Correction of the data, an option or a line of numpy; empty if there is none.
        read: Score of the data as they were read; None if nothing was compared.
        fits: The same score under the convention that fits.
        score: Meaning of both scores with their unit.

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
