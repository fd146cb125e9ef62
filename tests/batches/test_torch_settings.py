"""What a program sets in torch for itself holds again after our blocks, and does not hold within them."""

import threading

import pytest
import torch

from ast_sim.batches.torch_settings import float32_layers, tensors_on_cpu, usual_settings

matmul = torch.backends.mkldnn.matmul


@pytest.fixture
def bfloat16_products():
    before = matmul.fp32_precision
    matmul.fp32_precision = "bf16"
    yield
    matmul.fp32_precision = before


def test_the_usual_settings(bfloat16_products):
    with torch.device("meta"), torch.autocast("cpu", torch.bfloat16), torch.inference_mode():
        with usual_settings():
            assert torch.zeros(1).device.type == "cpu" and not torch.is_autocast_enabled("cpu")
            assert torch.is_grad_enabled() and not torch.zeros(1).is_inference()
            assert matmul.fp32_precision == "ieee"
        assert torch.zeros(1).device.type == "meta" and torch.is_autocast_enabled("cpu")
        assert torch.is_inference_mode_enabled() and matmul.fp32_precision == "bf16"
    with torch.no_grad():
        with usual_settings():
            assert torch.is_grad_enabled()
        assert not torch.is_grad_enabled()


def test_the_last_thread_puts_the_precision_back(bfloat16_products):
    begun, end = threading.Event(), threading.Event()

    def other():
        with usual_settings():
            begun.set()
            end.wait()

    thread = threading.Thread(target=other)
    with usual_settings():
        thread.start()
        begun.wait()
    assert matmul.fp32_precision == "ieee"
    end.set()
    thread.join()
    assert matmul.fp32_precision == "bf16"


def test_errors_leave_the_settings_as_they_were(bfloat16_products):
    torch.set_default_dtype(torch.float64)
    try:
        for block in (usual_settings, float32_layers, tensors_on_cpu):
            with torch.device("meta"), pytest.raises(ZeroDivisionError), block():
                assert torch.get_default_dtype() == (torch.float32 if block is float32_layers else torch.float64)
                raise ZeroDivisionError
            assert torch.get_default_dtype() == torch.float64 and matmul.fp32_precision == "bf16"
    finally:
        torch.set_default_dtype(torch.float32)
