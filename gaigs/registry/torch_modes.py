"""Global modes of torch, which gaigs restores after use."""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

_switching = threading.Lock()
_callers: list[Any] = []  # the default dtype before each call


@contextlib.contextmanager
def usual_modes() -> Iterator[None]:
    """Float32 as torch's default dtype, and no inference mode, while gaigs computes.

    It also works as a decorator. Threads share the default dtype: the first thread sets float32,
    and the last one restores the caller's dtype. Lightning changes the dtype.
    """
    import torch  # slow to import

    # Leaving an inference mode that was off would switch gradients on.
    is_inference = torch.is_inference_mode_enabled()
    no_inference = torch.inference_mode(False) if is_inference else contextlib.nullcontext()
    with _switching:
        _callers.append(torch.get_default_dtype())
        if len(_callers) == 1:
            torch.set_default_dtype(torch.float32)
    try:
        with no_inference:
            yield
    finally:
        with _switching:
            if len(_callers) == 1:
                torch.set_default_dtype(_callers[0])
            _callers.pop()
