"""One thread: the tests' tensors are small, and two that spin on a busy machine are several times
slower.

Properties are tried on the same examples each time, and none is timed.
"""

import copy
import functools
import gc
import inspect
import os
import pickle
import re
import signal
import sys
from collections import Counter
from pathlib import Path

import jaxtyping
import pytest
import torch
from hypothesis import HealthCheck, Phase, settings

ROOT = Path(__file__).parents[1]

torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that tests start
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # each of these would compile all modules
sys.dont_write_bytecode = False  # nor does each run compile all modules and tests
signal.signal(
    signal.SIGINT, signal.default_int_handler
)  # ignored where a shell runs the tests in the background
settings.register_profile(
    "gaigs",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=25,
    phases=[
        Phase.explicit,
        Phase.generate,
        Phase.shrink,
    ],  # the others are slow, or need a database
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("gaigs")

VALUES = re.compile(r"\+{0,2}(seed|ensemble|kriging|baselines|save_every|(?!hydra)\w+\.[\w.]+)=")
"""Words that set a value, and choose no file."""

check_all_calls = jaxtyping.jaxtyped
checked_calls = Counter()
"""Calls that were checked in the current scope, a module or a test, by the code of the function."""

checking = {"scope": None, "most": 3}

CHECKED = ("test_contracts", "hard_cases", "properties", "contracts")
"""Modules and folders whose tests check five calls each: they call each part with all shapes."""

FITTED = {"kriging", "calibration", "commands", "data", "benchmarks"}
"""Folders whose tests need hyperparameters of levels as a user has them."""

LEARNT = {"test_front_ends"}
"""Modules whose tests need responses of front ends as a user has them."""


def check_first_calls(function=None, *, typechecker):
    """``jaxtyping.jaxtyped`` for the first calls alone, made when they come.

    A loop calls a function with the same shapes thousands of times; checking all of them takes as
    long as all else.
    """
    if function is None:
        return functools.partial(check_first_calls, typechecker=typechecker)
    if not inspect.isfunction(function):
        return check_all_calls(function, typechecker=typechecker)  # which hands over its methods
    if not function.__annotations__:
        return function
    key, checked = id(function.__code__), None  # a nested function has one code, however often made

    @functools.wraps(function)
    def checked_at_first(*args, **kwargs):
        nonlocal checked
        if checked_calls[key] >= checking["most"] or jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        checked_calls[key] += 1
        checked = checked or check_all_calls(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return checked_at_first


jaxtyping.jaxtyped = jaxtyping._decorator.jaxtyped = check_first_calls


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Five calls are checked in each test of ``CHECKED``, else three in each module; processes of
    levels are fitted in a few steps, but for ``FITTED``; and responses of front ends are looked for
    in a few turns, but for ``LEARNT``.
    """
    is_each = not {*CHECKED}.isdisjoint(item.path.with_suffix("").parts)
    scope = item.nodeid if is_each else item.path
    if checking["scope"] != scope:
        from gaigs import data
        from gaigs.core.front_ends import FrontEndOptions
        from gaigs.data.front_ends import learn_responses
        from gaigs.kriging.scalar import ScalarOptions, ScalarProcess

        # All channels that are read are searched for a response, which few tests have put there.
        brief = functools.partial(learn_responses, options=FrontEndOptions(folds=2, rounds=2))
        data.learn_responses = learn_responses if item.path.stem in LEARNT else brief
        # Fits of levels to the last digit are most of a small run's time.
        is_fitted = not FITTED.isdisjoint(item.path.parts)
        quick = ScalarOptions(neighbours=8, iterations=4)
        ScalarProcess.options = ScalarOptions() if is_fitted else quick
        checked_calls.clear()
        checking.update(scope=scope, most=5 if is_each else 3)


# Modules and tests stay: a search for garbage among them takes a fifth of their collection
gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def quick_runs():
    """Figures, times and a thousand resamples take longer than all else of a run; the report's
    tests and processes have them.
    """
    from gaigs.report.paired import paired

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gaigs.runs.evaluation.paired", functools.partial(paired, resamples=20))
        patch.setattr("gaigs.report.run_figures.write_figures", lambda *_: None)
        patch.setattr("gaigs.runs.evaluation.median_ms", lambda work: (work(), 1.0)[1])
        yield


@pytest.fixture(scope="session", autouse=True)
def searched_once():
    """The plug-ins of this repository stay: each run looks for them ninety times."""
    from gaigs.registry import discovery

    search, found = discovery._dropped_holders, functools.cache(discovery._dropped_holders)

    def once(kind=None):
        if Path.cwd() != ROOT:
            return search(kind)
        holders, unreadable = found(kind)
        return [*holders], [*unreadable]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(discovery, "_dropped_holders", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def simulated_once():
    """Copies of the built-in room's spectra at few places: a hundred runs have the same ones."""
    from gaigs.data import synthetic

    simulate, found = synthetic.simulate_spectra, {}

    def once(room, spectrum, transmitters, *options):
        key = (repr(room.respond), repr(room.poses), spectrum, transmitters, repr(options))
        if not isinstance(transmitters, int) or transmitters > 40:
            return simulate(room, spectrum, transmitters, *options)
        if key not in found:
            found[key] = simulate(room, spectrum, transmitters, *options)
        return copy.deepcopy(found[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "simulate_spectra", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def composed_once():
    """Copies of a configuration for the same choices, while no file and no component changes; Hydra
    takes 0.2 s.
    """
    import hydra
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    from gaigs.registry import KINDS, registry

    compose, found = hydra.compose, {}

    def composed(name, words):
        folders = [
            element.path
            for element in GlobalHydra.instance().config_loader().get_search_path().get_path()
        ]
        written = () if Path.cwd() == ROOT else Path.cwd().glob("plugins/**/*")
        files = [(file, file.stat().st_mtime_ns) for file in written]
        held = [(kind, *item) for kind in KINDS for item in registry(kind)._registered.items()]
        invented = [
            item for item in held if not str(item[2].__module__).startswith(("gaigs", "plugins"))
        ]
        state = (
            *folders,
            *sys.path,
            *files,
            *invented,
            Path.cwd() if files or Path.cwd() == ROOT else None,
            *words,
        )
        if state not in found:
            found[state] = pickle.dumps(compose(name, words))  # a tenth of a deep copy's time
        return pickle.loads(found[state])

    def once(name, words):
        # Hydra sets values in the composed configuration: hundreds of runs differ by these alone.
        values = [word for word in words if VALUES.match(word)]
        overrides = OverridesParser.create().parse_overrides(values)
        if any(override.is_sweep_override() for override in overrides):
            return compose(name, words)
        config = composed(name, [word for word in words if word not in values])
        try:
            ConfigLoaderImpl._apply_overrides_to_config(overrides, config)
        except HydraException:
            return compose(name, words)  # raises it
        return config

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hydra, "compose", once)
        yield


@pytest.fixture(scope="session", autouse=True)
def files_read_once():
    """Copies of a configuration's file while none changes: reading takes a third of a composition."""
    from hydra._internal.config_repository import ConfigRepository

    read, found = ConfigRepository.load_config, {}

    def written(source, name):
        if source.scheme() != "file" or source.path.startswith(str(ROOT)):
            return None  # files of this repository stay
        file = Path(source.path, name).with_suffix(".yaml")
        return file.stat().st_mtime_ns if file.exists() else None

    def once(self, config_path):
        states = ((source.path, written(source, config_path)) for source in self.sources)
        key = (*states, config_path)
        if key not in found:
            found[key] = pickle.dumps(read(self, config_path))
        return pickle.loads(found[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigRepository, "load_config", once)
        yield


@pytest.fixture
def unchecked():
    """For runs from end to end: a third of their time is checks of annotations, which tests of the
    parts have.
    """
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.fixture(scope="session")
def tracer(tmp_path_factory):
    """Sionna RT with few rays and a cache of its own, or the test is skipped."""
    from gaigs_sionna import tracing

    try:
        tracing.find_packages()
        library = tracing.find_llvm()
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    with pytest.MonkeyPatch.context() as patch:
        kernels = (
            Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "pocl" / "kcache"
        )
        patch.setenv(
            "POCL_CACHE_DIR", os.environ.get("POCL_CACHE_DIR", str(kernels))
        )  # OpenCL keeps its own
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("DRJIT_LIBLLVM_PATH", library)
        patch.setattr(tracing, "RAYS", 5_000)
        patch.setattr(tracing, "CANDIDATES", 20_000)
        yield tracing
