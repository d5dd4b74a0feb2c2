"""Memory of a propagation: bounded by its pieces, whatever the numbers of data, chains and nodes.

In processes of their own, and from small to large, because the peak of a process never falls.
"""

import json
import os
import subprocess
import sys

import pytest

resource = pytest.importorskip("resource")

MIB = 2**20
MOST = 4 * 1024 * MIB
"""Of 100,000 data, 256 chains and 2401 nodes."""

PROGRAM = """
import json, resource, sys, time
import torch
import torchcal as tc

torch.set_num_threads(1)


def peak():
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size if sys.platform == "darwin" else 1024 * size


def model(x, p):  # four operations on numbers of full size, all kept for the gradient
    return (p["a"] + p["b"] * x) * (p["c"] + p["d"] * x).tanh()


simulator = tc.Simulator(model, [tc.Parameter(name) for name in "abcd"])
peaks = [peak()]
for chains, n, gauss, max_elements in json.loads(sys.argv[1]):
    start = time.perf_counter()
    x = torch.linspace(-1, 1, n, dtype=torch.float64)
    propagate = tc.NISP(simulator, tc.embeddings.Gaussian(), x, rule=gauss, max_elements=max_elements)
    assert propagate.num_nodes == gauss**4
    alpha = torch.randn(chains, propagate.num_alpha, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    alpha = (0.3 * alpha).requires_grad_(True)
    mean, sd = propagate(alpha)
    (mean.sum() + sd.sum()).backward()
    assert bool(torch.isfinite(alpha.grad).all()) and float(alpha.grad.abs().max()) > 0
    del x, propagate, mean, sd
    peaks.append(peak())
    print(f"{time.perf_counter() - start:.1f} s", file=sys.stderr)
print(json.dumps(peaks))
"""


def peaks(*sizes):
    """Peak resident size in bytes before any, and after each forward pass with its gradient, one after another.

    Args:
        sizes: Chains, data, Gauss nodes per germ (of four) and ``max_elements`` of each.
    """
    # glibc gives blocks from this size on back to the system: else small pieces would leave holes that count as used.
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536"}
    command = [sys.executable, "-c", PROGRAM, json.dumps(sizes)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    print(done.stderr)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_peak_memory_grows_with_neither_nodes_nor_chains():
    """What a piece leaves behind for the gradient must not be kept for all of them."""
    piece = 2**18
    _, few, nodes, chains = peaks((1, 3500, 3, piece), (1, 3500, 7, piece), (100, 1000, 3, piece))
    # A kept array of all outputs takes 62 MiB of 2320 more nodes, and as much of 100 chains with 81 nodes; the model
    # alone keeps several. A piece is 2 MiB.
    assert nodes - few < 40 * MIB
    assert chains - nodes < 40 * MIB


def test_the_moments_of_100_000_data_and_256_chains_fit():
    """With one node, of which no pieces can be kept. Data and pieces an eighth, and so is every array."""
    before, after = peaks((256, 12_500, 1, 2**21))
    assert before + 8 * (after - before) < MOST


@pytest.mark.slow
def test_the_full_size_fits():
    """Of 100,000 data, 256 chains and 2401 nodes: 6e10 outputs take hours, so the peak is measured in two parts.

    A chain is larger than a piece, so chains come one after another: the peak is what the moments of all of them take,
    and on top what one chain needs.
    """
    before, one, two = peaks((1, 100_000, 7, 2**24), (2, 100_000, 7, 2**24))
    # Mean, variance, sd and their gradients are some seven arrays of a chain's outputs.
    assert two - one < 7 * 8 * 100_000 + 100 * MIB
    _, moments = peaks((256, 100_000, 1, 2**24))
    assert moments + two - before < MOST
