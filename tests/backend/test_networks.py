# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's networks: layers against torch_geometric's with the same weights, and equal to themselves."""
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import sight  # noqa: E402
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


@pytest.mark.parametrize(("name", "options"), [("TransformerConv", {}), ("TransformerConv", {"edge_dim": 5}),
                                               ("GATv2Conv", {"add_self_loops": False})])
def test_layers_are_torch_geometrics(edges, name, options):
    geometric = pytest.importorskip("torch_geometric.nn")
    torch.manual_seed(1)
    source, start, index = edges
    theirs = getattr(geometric, name)(20, 8, heads=4, **options)
    told = [options["edge_dim"]] if "edge_dim" in options else []
    ours = getattr(layers, name)(20, 8, 4, *told)
    ours.load_state_dict(theirs.state_dict())
    one = torch.randn(len(start) - 1, 20, requires_grad=True)
    two = one.detach().clone().requires_grad_()
    edge = [torch.randn(len(source), *told)] if told else []
    a, b = theirs(one, index, *edge), ours(two, source, start, *edge)
    np.testing.assert_allclose(b.detach(), a.detach(), atol=1e-5)
    weight = torch.randn_like(a)
    (a * weight).sum().backward()
    (b * weight).sum().backward()
    np.testing.assert_allclose(two.grad, one.grad, atol=1e-5)
    for key, left in theirs.named_parameters():
        np.testing.assert_allclose(ours.get_parameter(key).grad, left.grad, atol=2e-5, rtol=1e-4, err_msg=key)


@pytest.fixture(params=[paper.Mlp, paper.VisibilityNet, paper.TwoStage,
                        lambda: paper.CoefficientsNet(paper.BLADE_COUNT)], ids=["mlp", "stage 1", "both", "end to end"])
def network(request):
    torch.manual_seed(2)
    made = request.param().eval()
    for parameter in made.parameters():  # the last layer of stage 2 begins at zero
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    return made


def told(index, source):
    """Something of each edge, whatever their order: (E, EDGE)."""
    one, other = index[1].double(), source.double()
    return torch.stack([torch.sin(one * (1 + k) + other * (2 + 3 * k)) for k in range(paper.EDGE)], 1).float()


def answered(network, x, source, start, edge):
    """The first that a network gives; stage 1 is given the same graph, all of it at once."""
    if isinstance(network, paper.VisibilityNet):
        return network(x, source, start, edge)
    if isinstance(network, paper.TwoStage):
        return network(x, source, start, [paper.Sight(x, source, start, edge, torch.arange(len(x)))])[0]
    return network(x, source, start)


def test_chunks_threads_and_order_of_the_vertices_do_not_matter(network, edges, monkeypatch):
    source, start, index = edges
    count = len(start) - 1
    x, edge = torch.randn(count, paper.BLADE_COUNT), told(index, source)
    with torch.no_grad():
        whole = answered(network, x, source, start, edge)
        assert torch.isfinite(whole).all() and whole.std() > 1e-3
        monkeypatch.setattr(layers, "EDGES_AT_ONCE", 300)
        np.testing.assert_allclose(answered(network, x, source, start, edge), whole, atol=1e-5)
        threads = torch.get_num_threads()
        torch.set_num_threads(2 if threads == 1 else 1)
        np.testing.assert_allclose(answered(network, x, source, start, edge), whole, atol=1e-5)
        torch.set_num_threads(threads)
        mixed = torch.randperm(count)
        back = torch.argsort(mixed)
        target, order = torch.sort(back[index[1]], stable=True)
        begin = torch.searchsorted(target, torch.arange(count + 1))
        np.testing.assert_allclose(answered(network, x[mixed], back[index[0]][order], begin, edge[order]), whole[mixed],
                                   atol=1e-5)


def test_of_a_mesh_chunks_and_order_do_not_matter_either(monkeypatch):
    """Both stages of a whole mesh, with the points that it hears chosen anew."""
    torch.manual_seed(3)
    network = paper.TwoStage().eval()
    torch.nn.init.normal_(network.coefficients.leave.weight)
    mesh = TriangleMesh.from_triangles(*shapes.torus(sections=16))

    def found(order):
        where = np.argsort(order)
        known = sight.places(mesh.points[order], mesh.normals[order])
        links = neighbours(TriangleMesh.from_triangles(mesh.positions[order], where[mesh.triangles]))
        joined = graph(mesh.points[order], links)
        parts = (sight.Sight(*map(torch.from_numpy, part)) for part in known.sights())
        with torch.no_grad():
            blocked, logits = network(torch.from_numpy(sight.encode(known.points, known.normals)),
                                      torch.from_numpy(joined.source), torch.from_numpy(joined.start), parts)
        return np.concatenate([blocked, logits], 1)[where]

    every = np.arange(len(mesh.points))
    whole = found(every)
    np.testing.assert_allclose(found(np.random.default_rng(0).permutation(every)), whole, atol=1e-4)
    monkeypatch.setattr(sight, "CHUNK", 100)
    np.testing.assert_allclose(found(every), whole, atol=1e-4)


def test_sizes_are_the_papers():
    both = paper.TwoStage()
    assert both.visibility.enter.weight.shape == (64, 32) and len(both.visibility.blocks) == 3
    assert both.visibility.leave.weight.shape == (25, 64)
    assert both.coefficients.enter.weight.shape == (96, 57) and len(both.coefficients.blocks) == 5
    assert both.coefficients.dropout.p == 0.2 and both.coefficients.leave.weight.shape == (9, 96)


def test_no_gradient_goes_through_the_visibilities(edges):
    source, start, _ = edges
    both = paper.TwoStage()
    x = torch.randn(len(start) - 1, paper.BLADE_COUNT)
    edge = torch.randn(len(source), paper.EDGE)
    found, _ = both(x, source, start, [paper.Sight(x, source, start, edge, torch.arange(len(x)))])
    found.sum().backward()
    assert all(parameter.grad is None for parameter in both.visibility.parameters())
