"""Revisions come when the model asks for them, and a resumed training makes each once."""

import math
from dataclasses import replace

import pytest
import torch
from fitting import Plane, Watch, fit, make_module

from gaigs.data import Split
from gaigs.training.checkpoints import Interrupted, KeepLast
from gaigs.training.revision import Revision


class Revised(Plane):
    """A plane that turns at random, three times, and records the calls."""

    revisions = (0.0, 0.25, 0.5)

    def __init__(self, scene):
        super().__init__(scene)
        self.register_buffer("times", torch.zeros(()))
        self.looks = []

    def revise(self, number, train, validation, loss):
        assert not torch.is_grad_enabled()
        assert not self.training
        self.looks.append((number, train, validation, loss(train), self.slope.clone()))
        self.times += 1
        self.slope += 0.1 * torch.randn(2)
        return f"turned for the {number}th time"


def make(links):
    torch.manual_seed(0)
    return make_module(links, Revised(links.scene))


def log_of(caplog):
    return [
        record.getMessage() for record in caplog.records if record.name == "gaigs.training.revision"
    ]


@pytest.mark.parametrize("at", [1, 4])
def test_a_resumed_training_is_revised_as_an_uninterrupted_one(links, tmp_path, caplog, at):
    caplog.set_level("INFO")
    whole, part, rest = Watch(), Watch(at), Watch()
    path = tmp_path / "last.ckpt"
    uninterrupted, stopped, resumed = make(links), make(links), make(links)
    torch.manual_seed(0)
    fit(
        uninterrupted,
        links,
        tmp_path,
        8,
        Revision(links, 0),
        whole,
        KeepLast(tmp_path / "w.ckpt", every=math.inf),
    )
    lines = [
        f"step {step}: turned for the {number}th time" for number, step in enumerate((0, 2, 4))
    ]
    assert log_of(caplog) == lines
    caplog.clear()
    torch.manual_seed(0)
    with pytest.raises(Interrupted, match=f"stopped after step {at}$"):
        fit(stopped, links, tmp_path, 8, Revision(links, 0), part, KeepLast(path, every=math.inf))
    torch.manual_seed(7)
    fit(
        resumed,
        links,
        tmp_path,
        8,
        Revision(links, 0),
        rest,
        KeepLast(path, every=math.inf),
        resume=path,
    )
    assert log_of(caplog) == lines
    assert part.losses + rest.losses == whole.losses
    for name, value in uninterrupted.model.state_dict().items():
        assert torch.equal(resumed.model.state_dict()[name], value), name


def test_a_revision_gets_links_of_both_parts_and_their_loss(links, tmp_path):
    module, again, other = make(links), make(links), make(links)
    fit(module, links, tmp_path, 8, Revision(links, 0))
    places = links.query.transmitters
    for number, (own, train, validation, loss, slope) in enumerate(module.model.looks):
        assert (own, len(train), len(validation)) == (number, 8, 3)
        for batch, part in ((train, links.split.train), (validation, links.split.validation)):
            apart = (batch.query.transmitters[:, None] - places[part]).norm(dim=-1)
            assert (apart.amin(1) == 0).all()
        assert train.labels.shape[1:] != links.task.shape, "thinned as the steps' are"
        if number == 0:  # with the parameters of then
            model = Plane(links.scene)
            model.load_state_dict({**make(links).model.state_dict(), "slope": slope}, strict=False)
            assert loss == module.loss(model(train).value, train)[0].item(), "without penalties"
    fit(again, links, tmp_path, 2, Revision(links, 0))
    assert torch.equal(again.model.looks[0][1].labels, module.model.looks[0][1].labels)
    fit(other, links, tmp_path, 2, Revision(links, 1))
    assert not torch.equal(other.model.looks[0][1].labels, module.model.looks[0][1].labels)


def test_a_revision_gets_no_more_links_than_it_needs(links, tmp_path):
    count = 2 * 48
    copies = torch.arange(count) % len(links)
    parts = torch.arange(count - 1), torch.arange(0), torch.arange(count - 1, count)
    many = replace(
        links, query=links.query[copies], labels=links.labels[copies], split=Split("most", *parts)
    )
    module = make(many)
    fit(module, many, tmp_path, 4, Revision(many, 0), limit_val_batches=0)
    for _, train, validation, _, _ in module.model.looks:
        assert len(train) == 48
        assert validation is None
