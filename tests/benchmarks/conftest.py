"""What tests of studies share."""

import pytest
import torch


@pytest.fixture
def one_thread(monkeypatch):
    """The study changes the threads of this process and of others; they are set back."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)
