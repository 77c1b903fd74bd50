"""Agreement of labels with each other, by distance of places and order of measurement."""

import logging
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markdown import Markdown

from gaigs.commands.agreement.expectation import on_split
from gaigs.commands.agreement.page import write
from gaigs.commands.agreement.pairs import measure
from gaigs.data import load

log = logging.getLogger(__name__)


def run(config: dict, folder: Path) -> None:
    """Compares the labels of a data set; prints a table, and writes it with its figure."""
    links = load(config["data"], config["split"], config["task"]["name"])
    name = config["data"]["name"]
    remarks = links.remarks and f"; {links.remarks}"
    log.info("data: %s, %s links%s", name, f"{len(links):,}", remarks)
    random = np.random.default_rng(config["seed"])
    agreement = measure(links, random)
    rows, split_remarks = on_split(agreement, links, random, config["baselines"])
    remarks = [
        f"data {name}, {len(links):,} links, seed {config['seed']}",
        *agreement.remarks(),
        *split_remarks,
    ]
    folder.mkdir(parents=True, exist_ok=True)
    cells = agreement.cells(links.task.compared_by)
    page = write(folder, links.task, cells, rows, links.split.name, remarks)
    Console().print(Markdown(page))
    print(f"results: {folder}")
