"""A folder to work in."""

import pytest
from command_line import write_photograph


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with in.png and its camera; no environment says that there are several processes."""
    monkeypatch.chdir(tmp_path)
    for name in ("TORCHELASTIC_RUN_ID", "RANK", "WORLD_SIZE", "SLURM_STEP_ID", "SLURM_PROCID", "SLURM_NTASKS"):
        monkeypatch.delenv(name, raising=False)
    write_photograph(tmp_path)
    return tmp_path
