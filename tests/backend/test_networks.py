# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's networks: layers against torch_geometric's with the same weights, and equal to themselves."""
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from neural_gash_addon.backend.geometry import TriangleMesh  # noqa: E402
from neural_gash_addon.backend.graph import graph  # noqa: E402
from neural_gash_addon.backend.neighbours import neighbours  # noqa: E402
from neural_gash_addon.backend.networks import layers, paper  # noqa: E402

from . import shapes  # noqa: E402


@pytest.fixture(scope="module")
def edges():
    """source, start, and torch_geometric's edge index, of a torus; the last vertex has no edge."""
    mesh = TriangleMesh.from_triangles(*shapes.torus(sections=16))
    found = graph(mesh.points, neighbours(mesh))
    start = torch.from_numpy(np.append(found.start, found.start[-1]))
    source = torch.from_numpy(found.source)
    target = torch.repeat_interleave(torch.arange(len(start) - 1), start.diff())
    return source, start, torch.stack([source, target])


@pytest.mark.parametrize("name", ["TransformerConv", "GATv2Conv"])
def test_layers_are_torch_geometrics(edges, name):
    geometric = pytest.importorskip("torch_geometric.nn")
    torch.manual_seed(1)
    source, start, index = edges
    options = {"add_self_loops": False} if name == "GATv2Conv" else {}
    theirs = getattr(geometric, name)(20, 8, heads=4, **options)
    ours = getattr(layers, name)(20, 8, 4)
    ours.load_state_dict(theirs.state_dict())
    one = torch.randn(len(start) - 1, 20, requires_grad=True)
    two = one.detach().clone().requires_grad_()
    a, b = theirs(one, index), ours(two, source, start)
    np.testing.assert_allclose(b.detach(), a.detach(), atol=1e-5)
    weight = torch.randn_like(a)
    (a * weight).sum().backward()
    (b * weight).sum().backward()
    np.testing.assert_allclose(two.grad, one.grad, atol=1e-5)
    for (key, left), right in zip(theirs.named_parameters(), ours.parameters(), strict=True):
        np.testing.assert_allclose(right.grad, left.grad, atol=2e-5, rtol=1e-4, err_msg=key)


@pytest.fixture(params=[paper.Mlp, paper.VisibilityNet, paper.TwoStage,
                        lambda: paper.CoefficientsNet(paper.BLADE_COUNT)], ids=["mlp", "stage 1", "both", "end to end"])
def network(request):
    torch.manual_seed(2)
    return request.param().eval()


def first(output):
    return output[0] if isinstance(output, tuple) else output


def test_chunks_threads_and_order_of_the_vertices_do_not_matter(network, edges, monkeypatch):
    source, start, index = edges
    count = len(start) - 1
    x = torch.randn(count, paper.BLADE_COUNT)
    with torch.no_grad():
        whole = first(network(x, source, start))
        assert torch.isfinite(whole).all()
        monkeypatch.setattr(layers, "EDGES_AT_ONCE", 300)
        np.testing.assert_allclose(first(network(x, source, start)), whole, atol=1e-5)
        threads = torch.get_num_threads()
        torch.set_num_threads(2 if threads == 1 else 1)
        np.testing.assert_allclose(first(network(x, source, start)), whole, atol=1e-5)
        torch.set_num_threads(threads)
        mixed = torch.randperm(count)
        back = torch.argsort(mixed)
        target, order = torch.sort(back[index[1]], stable=True)
        begin = torch.searchsorted(target, torch.arange(count + 1))
        np.testing.assert_allclose(first(network(x[mixed], back[index[0]][order], begin)), whole[mixed], atol=1e-5)


def test_sizes_are_the_papers():
    both = paper.TwoStage()
    assert both.visibility.enter.weight.shape == (64, 32) and len(both.visibility.blocks) == 3
    assert both.visibility.leave.weight.shape == (25, 64)
    assert both.coefficients.enter.weight.shape == (96, 57) and len(both.coefficients.blocks) == 5
    assert both.coefficients.dropout.p == 0.2 and both.coefficients.leave.weight.shape == (9, 96)


def test_no_gradient_goes_through_the_visibilities(edges):
    source, start, _ = edges
    both = paper.TwoStage()
    found, _ = both(torch.randn(len(start) - 1, paper.BLADE_COUNT), source, start)
    found.sum().backward()
    assert all(parameter.grad is None for parameter in both.visibility.parameters())
