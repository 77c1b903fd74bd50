"""Revisions come when the model asks for them, and a training that goes on has made them once."""

import math
import os
import signal
from dataclasses import replace

import pytest
import torch
from fitting import Plane, fit, make_links, make_module
from lightning.pytorch.callbacks import Callback

from gaigs.data import Split
from gaigs.training.callbacks import Interrupted, KeepLast
from gaigs.training.revision import LINKS, Revision


class Revised(Plane):
    """A plane that is turned by chance, three times, and keeps how often."""

    revisions = (0.0, 0.25, 0.5)

    def __init__(self, scene):
        super().__init__(scene)
        self.register_buffer("times", torch.zeros(()))
        self.looks = []

    def revise(self, number, train, validation, loss):
        assert not torch.is_grad_enabled()
        assert not self.training
        self.looks.append((number, train, validation, loss(train)))
        self.times += 1
        self.slope += 0.1 * torch.randn(2)
        return f"turned for the {number}th time"


class Watch(Callback):
    """Losses and modes of all steps; is interrupted behind one of them."""

    def __init__(self, at=None):
        self.losses, self.at = [], at

    def on_train_batch_start(self, trainer, module, *_):
        assert module.model.training

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.losses.append(outputs["loss"].item())
        if trainer.global_step == self.at:
            os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture(scope="module")
def links():
    return make_links()


@pytest.fixture(autouse=True)
def handler():
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


def make(links):
    torch.manual_seed(0)
    return make_module(links, Revised(links.scene))


def turns(caplog):
    return [record.getMessage() for record in caplog.records if record.name == "gaigs.training.revision"]


def test_a_revision_comes_after_its_share_of_the_steps(links, tmp_path, caplog):
    caplog.set_level("INFO")
    module = make(links)
    fit(module, links, tmp_path, 10, Revision(links, 0))
    assert turns(caplog) == [
        "step 0: turned for the 0th time",
        "step 2: turned for the 1th time",
        "step 5: turned for the 2th time",
    ]
    assert module.model.times == 3


def test_a_model_that_asks_for_none_is_left_alone(links, tmp_path, caplog):
    caplog.set_level("INFO")
    fit(make_module(links), links, tmp_path, 4, Revision(links, 0))
    assert turns(caplog) == []


@pytest.mark.parametrize("at", [1, 4, 7])
def test_a_training_that_goes_on_is_revised_as_if_it_had_never_stopped(links, tmp_path, caplog, at):
    caplog.set_level("INFO")
    whole, part, rest = Watch(), Watch(at), Watch()
    path = tmp_path / "last.ckpt"
    uninterrupted, stopped, resumed = make(links), make(links), make(links)
    torch.manual_seed(0)
    fit(uninterrupted, links, tmp_path, 8, Revision(links, 0), whole, KeepLast(tmp_path / "w.ckpt", every=math.inf))
    told = turns(caplog)
    caplog.clear()
    torch.manual_seed(0)
    with pytest.raises(Interrupted, match=f"stopped after step {at}$"):
        fit(stopped, links, tmp_path, 8, Revision(links, 0), part, KeepLast(path, every=math.inf))
    torch.manual_seed(7)
    fit(resumed, links, tmp_path, 8, Revision(links, 0), rest, KeepLast(path, every=math.inf), resume=path)
    assert turns(caplog) == told
    assert part.losses + rest.losses == whole.losses
    assert resumed.model.times == 3
    for name, value in uninterrupted.model.state_dict().items():
        assert torch.equal(resumed.model.state_dict()[name], value), name


def test_it_looks_at_links_that_train_and_at_links_that_validate(links, tmp_path):
    module = make(links)
    fit(module, links, tmp_path, 8, Revision(links, 0))
    places = links.query.transmitters
    losses = []
    for number, train, validation, loss in module.model.looks:
        assert len(train) == 8
        assert len(validation) == 3
        for batch, part in ((train, links.split.train), (validation, links.split.validation)):
            apart = (batch.query.transmitters[:, None] - places[part]).norm(dim=-1)
            assert (apart.amin(1) == 0).all()
        assert train.labels.shape[1:] != links.task.shape  # thinned as the steps' are
        assert number == len(losses)
        losses.append(loss)
    assert len({*losses}) == 3
    _, train, _, _ = module.model.looks[0]
    again = make(links)
    fit(again, links, tmp_path, 8, Revision(links, 0))
    assert torch.equal(again.model.looks[0][1].labels, train.labels)
    other = make(links)
    fit(other, links, tmp_path, 8, Revision(links, 1))
    assert not torch.equal(other.model.looks[0][1].labels, train.labels)


def test_the_loss_is_that_of_the_labels_without_penalties(links, tmp_path):
    module = make(links)
    found = []

    def revise(number, train, validation, loss):
        expected, _ = module.loss(module.model(train).value, train)
        found.append((loss(train), expected.item()))
        return ""

    module.model.revise = revise
    fit(module, links, tmp_path, 4, Revision(links, 0))
    assert len(found) == 3
    assert all(given == expected for given, expected in found)


def test_it_looks_at_no_more_links_than_it_needs(tmp_path):
    links = make_links()
    count = 2 * LINKS
    copies = torch.arange(count) % len(links)
    many = replace(
        links,
        query=links.query[copies],
        labels=links.labels[copies],
        split=Split(
            "all but none to validate", torch.arange(count - 1), torch.arange(0), torch.arange(count - 1, count)
        ),
    )
    module = make(many)
    fit(module, many, tmp_path, 4, Revision(many, 0), limit_val_batches=0)
    for _, train, validation, _ in module.model.looks:
        assert len(train) == LINKS
        assert validation is None
