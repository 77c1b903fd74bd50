"""One thread: the tests' tensors are small, and two that spin on a busy machine are several times slower."""

import torch

torch.set_num_threads(1)
