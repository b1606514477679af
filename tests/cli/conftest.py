"""A folder to work in."""

import pytest
from command_line import write_photograph


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with in.png and its camera."""
    monkeypatch.chdir(tmp_path)
    write_photograph(tmp_path)
    return tmp_path
