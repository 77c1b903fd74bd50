"""The split that came with the data."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, check_validation, generator_of, hold_out, places_of, rows_of, runs_of


@register("split", "official")
def official(
    links: Links, length: int = 1, validation: float | None = None, seed: int = 0
) -> Split:
    """The data's own training and test links; validation links are drawn from the training links.

    Args:
        length: Rows in a validation run; more than 1 if the test is a separate run. Runs become
            shorter if fewer than four would validate.
        validation: Fraction of the training links to validate on; for runs an upper bound. 0 for
            none. None: 0.1, or more if there are few links, see ``gaigs.split.hold_out``.

    Raises:
        ValueError: The data have no official split, or an option is out of range.
    """
    if links.official is None:
        raise ValueError(
            "this data has no official split; choose split=random, sparse, runs or blocks"
        )
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    check_validation(validation)
    generator = generator_of(seed)
    train, test = (part.sort().values for part in links.official())
    rows = rows_of(links)
    # Four runs or more validate.
    fraction = 0.1 if validation is None else validation
    validating_rows = fraction * len(rows[train].unique())
    length = min(length, max(1, int(validating_rows / 4)))
    has_runs = length > 1
    groups = runs_of(links, length) if has_runs else places_of(links)
    # Runs are large, so the nearest number of runs could be far above the fraction.
    drawn_by = {"at_most": True} if has_runs else {"rows": rows}
    train, validating, share = hold_out(
        "validation", train, groups, links.query.votes, validation, generator, **drawn_by
    )
    words = ["official"]
    if share:
        runs = f" in runs of {length}" if has_runs else ""
        words += [f"validation {share:g}{runs}", f"seed {seed}"]
    return Split(", ".join(words), train, validating, test, groups)
