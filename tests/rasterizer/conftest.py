"""Whether OpenCL can be tested here."""

import pytest


@pytest.fixture(scope="session")
def opencl_works():
    """Skips where there is no driver, or one that does not know the processor, with the reason."""
    opencl = pytest.importorskip("gaigs.rasterizer.opencl", exc_type=ImportError)
    try:
        opencl.OpenCLRasterizer()
    except RuntimeError as error:
        pytest.skip(str(error))
