"""The allocator keeps the memory that training frees."""

import platform
import subprocess
import sys

import pytest

COUNT_FAULTS = """
import resource
import torch
from tcmrl_algo.training.train import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        torch.ones(2**24)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
given_back = faults()
keep_freed_memory()
for _ in range(10):  # until the heap has grown
    faults()
print(given_back, faults())
"""


@pytest.mark.check
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator alone can be told")
def test_freed_tensors_are_asked_for_anew_without_page_faults() -> None:
    """Runs in a separate process, because the setting is permanent."""
    command = [sys.executable, "-c", COUNT_FAULTS]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    given_back, kept = map(int, found)
    assert given_back > 5 * 16  # a tensor of 64 MiB each time, in pages of 4 MiB or less
    assert kept < given_back / 10
