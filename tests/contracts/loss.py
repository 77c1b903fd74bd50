"""The check of kind ``loss``."""

from dataclasses import replace

import torch
from torch import Tensor

from gaigs.core.query import Batch
from gaigs.data import Links
from gaigs.splatting.loss import Loss
from gaigs.testing.checks import (
    PRECISION,
    require,
    require_close,
    require_gradients,
    require_tensor,
)


def check_loss(loss: Loss, links: Links, device: torch.device | str = "cpu") -> None:
    """Checks a loss: least at the labels, a mean over the links, finite gradients everywhere, terms
    by name.

    It is made with the task of the links. Labels on a grid are also compared on every second row
    and column. The contract is that of ``gaigs.splatting.loss.Loss``.
    """
    batch = links.batch(links.split.train[:6])
    batches = [batch]
    if batch.directions is not None:
        rows = columns = slice(1, None, 2)
        thinned = batch.directions.thin(rows, columns)
        batches.append(replace(batch, directions=thinned, labels=batch.labels[:, rows, columns]))
    for batch in batches:
        for dtype in PRECISION:
            kind = dtype.to_complex() if links.task.dtype.is_complex else dtype
            _check_batch(loss, replace(batch, labels=batch.labels.to(kind)).to(device), dtype)


def _check_batch(loss: Loss, batch: Batch, dtype: torch.dtype) -> None:
    labels = batch.labels
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(labels.shape, dtype=labels.dtype, generator=generator).to(labels.device)
    least, terms = loss(labels, batch)
    require(
        isinstance(terms, dict) and terms,
        f"terms must be a dictionary of at least one, got {terms!r}",
    )
    for name, term in terms.items():
        named = isinstance(name, str) and isinstance(term, Tensor)
        require(named, f"terms must be numbers by name, got {type(term).__name__} as {name!r}")
        require_tensor(f"the term {name}", term, (), dtype, labels.device)
    for scale in (1e-2, 0.3, -0.3, 10.0):
        values, case = labels + scale * noise, f"with errors of about {scale:g}"
        total, terms_there = loss(values, batch)
        require_tensor(f"the loss {case}", total, (), dtype, labels.device)
        require([*terms_there] == [*terms], "terms must be the same for all values")
        require(
            total > least,
            f"the loss must be least at the labels, got {least:g} there and {total:g} {case}",
        )

        def single(i):
            return replace(batch, query=batch.query[i : i + 1], labels=labels[i : i + 1])

        each = torch.stack([loss(values[i : i + 1], single(i))[0] for i in range(len(batch))])
        require_close(
            each.mean(), total, PRECISION[dtype], "the loss must be the mean over its links"
        )
    hard = {
        "at the labels": labels,
        "next to the labels": labels + 1e-12 * noise,
        "at zero": 0 * labels,
    }
    hard["far off"] = 1e3 * noise
    for case, values in hard.items():
        leaf = values.clone().requires_grad_()
        total, _ = loss(leaf, batch)
        require(total.requires_grad, "the loss must carry a gradient")
        require_gradients([total], {f"the values {case}": leaf})
    leaf = (labels + 0.1 * noise).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf, batch)[0], leaf)
    require(
        gradient[..., None].flatten(1).any(1).all(),
        "the loss must have a gradient for the value of each link",
    )
