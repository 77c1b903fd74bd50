import pytest
import torch

import gaigs
from gaigs.model.mirrored import MirroredSplatting

SIZE = 7.0, 5.0, 3.0


@pytest.fixture
def mirrored():
    """Mirrored Gaussians whose planes are the faces of the built-in room, of a carrier of 6.4896
    GHz.
    """
    torch.manual_seed(0)
    scene = gaigs.links("synthetic_csi", transmitters=10, order=0).scene
    model = MirroredSplatting(scene, {"name": "mirrored", "obstacles": 0})
    placement = model.placement
    for axis in range(3):
        normal = torch.eye(3)[axis]
        placement.place(axis, torch.tensor([*normal, SIZE[axis]]))
        placement.place(axis + 3, torch.tensor([*-normal, 0.0]))
    with torch.no_grad():
        placement.log_extents.fill_(10.0)
    return model
