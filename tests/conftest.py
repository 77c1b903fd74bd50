"""One thread: the tests' tensors are small, and two that spin on a busy machine are several times slower."""

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(scope="session")
def tracer(tmp_path_factory):
    """Sionna RT with few rays and a cache of its own, or the test is skipped."""
    from gaigs.data.sionna import tracing

    try:
        tracing.find_packages()
        library = tracing.find_llvm()
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("DRJIT_LIBLLVM_PATH", library)
        patch.setattr(tracing, "RAYS", 5_000)
        patch.setattr(tracing, "CANDIDATES", 20_000)
        yield tracing
