"""A split that holds out whole receivers."""

from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, check_validation, generator_of, hold_out, places_of, rows_of


@register("split", "receivers")
def receivers(
    links: Links,
    hold: str | Sequence[str] | None = None,
    test: float = 0.25,
    fold: str | None = None,
    validation: float | None = None,
    seed: int = 0,
) -> Split:
    """Tests on whole receivers. This measures the error at new positions of receivers.

    If three receivers or more remain, validation is on whole receivers, too; otherwise on random
    places.

    Args:
        hold: Names of the test receivers, or one name; None: random receivers.
        test: Fraction of the receivers to test on if they are random, at least one.
        fold: Fold of the receivers to test on, such as ``1/3`` for the first of three folds;
            replaces the fraction.
        validation: Fraction of the other receivers, or of their places, to validate on; 0 for none.
            None: 0.2 of receivers, 0.1 of places.
        seed: Seed of all random numbers.

    Raises:
        ValueError: An option is out of range, a name is unknown, or fewer than two receivers remain
            for the training.
    """
    check_validation(validation)
    check("test", test, 0 < test < 1, "in (0, 1)")
    generator = generator_of(seed)
    order = torch.randperm(len(links.receivers), generator=generator)
    # A place that is estimated would come from the links that are predicted.
    if links.uncertainties is not None:
        order = order[links.uncertainties[order].isfinite()]
    held, name = _held(links, order, hold, test, fold)
    if not torch.isin(held, order).all() or not len(held):
        raise ValueError(
            f"split=receivers tests at receivers of known places, of which the data have "
            f"{len(order)}; give others by data.gateways, or take split=random"
        )
    of_links = links.query.receivers  # receiver of each link
    remaining = of_links[~torch.isin(of_links, held)].unique()
    if len(remaining) < 2:
        raise ValueError(
            f"split=receivers leaves two receivers or more to train on, got {len(remaining)} of "
            f"{len(links.receivers)}; hold fewer, or take split=random"
        )
    order = order[torch.isin(order, remaining)]
    is_test = torch.isin(of_links, held)
    training = (~is_test).nonzero()[:, 0]
    if len(remaining) > 2 and validation != 0:
        share = 0.2 if validation is None else validation
        # Two receivers or more must be left to train on.
        count = min(max(1, round(share * len(order))), len(remaining) - 2)
        validating = order[:count]
        is_validating = torch.isin(of_links[training], validating)
        train, validated = training[~is_validating], training[is_validating]
        name += f", validation {len(validating)}"
    else:
        train, validated, share = hold_out(
            "validation",
            training,
            places_of(links),
            links.query.votes,
            validation,
            generator,
            rows=rows_of(links),
        )
        name += f", validation {share:g} of places" if share else ""
    name += f", seed {seed}"
    return Split(name, train, validated, is_test.nonzero()[:, 0], by_receivers=True)


def _held(
    links: Links,
    order: Int[Tensor, " r"],
    hold: str | Sequence[str] | None,
    test: float,
    fold: str | None,
) -> tuple[Int[Tensor, " h"], str]:
    """Numbers of the receivers to test on, and the name of the split.

    Args:
        order: All receivers in random order; fraction and fold select from it.
    """
    names = [receiver.name for receiver in links.receivers]
    if hold and fold is not None:
        raise ValueError("split.hold and split.fold both choose receivers; leave one out")
    if hold:
        hold = [hold] if isinstance(hold, str) else [*hold]
        for name in hold:
            if name not in names:
                raise ValueError(f"split.hold must name receivers of the data, got {name!r}")
        held = torch.tensor([names.index(name) for name in hold])
        return held, f"receivers {', '.join(hold)}"
    if fold is None:
        return order[: max(1, round(test * len(order)))], f"receivers, test {test:g}"
    number, _, count = fold.partition("/")
    is_fold = number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)
    if not is_fold or not 2 <= int(count) <= len(order):
        raise ValueError(
            f"split.fold must be a fold such as 1/3, of 2 to {len(order)} folds, got {fold!r}"
        )
    return order[int(number) - 1 :: int(count)], f"receivers, fold {fold}"
