import importlib

import pytest
from torchvision_stand_in import torchvision_of


@pytest.fixture(params=["stand-in", "real"])
def vision(request, monkeypatch):
    """The front end, as it is with a stand-in and with torchvision, and its tv_tensors."""
    with torchvision_of(request.param, monkeypatch) as tv_tensors:
        yield importlib.import_module("camtorch.augment.torchvision"), tv_tensors
