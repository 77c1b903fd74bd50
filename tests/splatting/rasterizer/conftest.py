import pytest


@pytest.fixture(scope="session")
def opencl_works():
    """Skips, with the reason, where no driver builds kernels."""
    opencl = pytest.importorskip("gaigs.splatting.rasterizer.opencl", exc_type=ImportError)
    try:
        opencl.OpenCLRasterizer()
    except RuntimeError as error:
        pytest.skip(str(error))
