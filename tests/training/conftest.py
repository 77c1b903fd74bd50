import signal

import pytest
from fitting import make_links

from gaigs.processes import STOPPING


@pytest.fixture(scope="session")
def links():
    return make_links()


@pytest.fixture(autouse=True)
def handlers():
    """Signals are handled after each test as before it."""
    before = {number: signal.getsignal(number) for number in STOPPING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
