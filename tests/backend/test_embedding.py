# SPDX-License-Identifier: GPL-3.0-or-later
"""The light-transport embedding: layers against loops over the paper's equations, and what holds for any room."""
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding, embedding_bake, serialise, weights  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.backend.methods import run  # noqa: E402
from neural_gash_addon.backend.networks import embedding as networks  # noqa: E402

TINY = networks.Settings(width=32, depths=(2, 1), channels=(32, 64), layers=2, dropout=0.0, gathered=6, around=4,
                         patch=16, neighbours=5)


def farthest(points, count, first=0):
    """Rows of farthest point sampling, as it is defined: each time the point farthest from those taken."""
    chosen = [first]
    while len(chosen) < count:
        away = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(1)
        chosen.append(int(away.argmax()))
    return chosen


@pytest.fixture(scope="module")
def room():
    """(150, 12) scene points of a box, with a lamp on the ceiling, in farthest-point order; (60, 9) queries."""
    rng = np.random.default_rng(3)
    size, count = np.array([5, 4, 2.5]), 400
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    positions = rng.random((count, 3)) * size + 1
    positions[np.arange(count), axis] = 1 + side * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = 1 - 2 * side
    albedo = rng.random((count, 3)) * 0.8
    lamp = (normals[:, 2] < 0) & (np.abs(positions[:, :2] - [3.5, 3]).max(1) < 1)
    points = np.concatenate([positions, normals, albedo, lamp[:, None] * np.array([[20, 15, 10]])], 1)
    assert lamp.sum() > 5
    return points[farthest(positions, 150)].astype(np.float32), points[-60:, :9].astype(np.float32)


@pytest.fixture(scope="module")
def model():
    return network()


def network(settings=TINY, seed=0):
    """One whose head is not at zero, as after training."""
    torch.manual_seed(seed)
    made = networks.Embedding(settings)
    torch.nn.init.normal_(made.decoder.leave.weight, std=0.3)
    return made.eval()


def irradiance(model, points, queries):
    return run(embedding_bake.Room(model, points).irradiance(queries))


def test_farthest_points_of_a_half_are_the_first_half(room):
    points = room[0][:, :3].astype(np.float64)
    for count in (75, 38):
        assert farthest(points[:2 * count], count) == list(range(count))


def test_the_layout_is_of_nearest_points(room):
    points = room[0][:, :3].astype(np.float64)
    found = embedding.layout(points, 2, 6, 4)
    counts = [150, 75, 38, 19]
    for rows, before, kept in zip(found.gathered, counts[:-1], counts[1:], strict=True):
        assert rows.shape == (kept, 6)
        away = cKDTree(points[:before]).query(points[:kept], 6)[0]
        np.testing.assert_allclose(np.linalg.norm(points[rows] - points[:kept, None], axis=2), away, rtol=1e-6)
    for rows, count in zip(found.around, counts[2:], strict=True):
        away = cKDTree(points[:count]).query(points[:count], 4)[0]
        np.testing.assert_allclose(np.linalg.norm(points[rows] - points[:count, None], axis=2), away, rtol=1e-6)
    assert len(found.above) == 1
    away = cKDTree(points[:19]).query(points[:38])[0]
    np.testing.assert_allclose(np.linalg.norm(points[found.above[0]] - points[:38], axis=1), away, rtol=1e-6)


def test_a_halving_is_the_greatest_projection_of_differences():
    """Equations 2 and 3 as they stand; what follows them is a norm and a GELU."""
    torch.manual_seed(0)
    layer = networks.Halving(7, 5)
    x, gathered = torch.randn(2, 20, 7), torch.randint(0, 20, (10, 4))
    project = torch.cat([layer.difference.weight, layer.centre.weight], 1)
    expected = torch.empty(2, 10, 5)
    for b in range(2):
        for row in range(10):
            pairs = [torch.cat([x[b, k] - x[b, row], x[b, row]]) for k in gathered[row]]
            expected[b, row] = torch.stack([project @ pair + layer.centre.bias for pair in pairs]).amax(0)
    expected = torch.nn.functional.gelu(layer.norm(expected))
    np.testing.assert_allclose(layer(x, gathered).detach(), expected.detach(), atol=1e-5)


def test_surroundings_are_a_depthwise_convolution():
    torch.manual_seed(0)
    layer = networks.Surroundings(6)
    x, places, around = torch.randn(2, 9, 6), torch.rand(9, 3), torch.randint(0, 9, (9, 4))
    expected = torch.zeros(2, 9, 6)
    for b in range(2):
        for row in range(9):
            for k in around[row]:
                offset = (places[k] - places[row]) * embedding.EXTENT
                expected[b, row] += x[b, k] * layer.kernel(offset) / 4
    np.testing.assert_allclose(layer(x, places, around).detach(), layer.norm(layer.leave(expected)).detach(), atol=1e-5)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 50, 64])
def test_attention_is_among_the_codes_of_a_patch(count):
    """One patch at a time, one code at a time; patches as equal as they can be, none above 16."""
    torch.manual_seed(count)
    layer = networks.PatchAttention(64, 16)
    x, order = torch.randn(2, count, 64), torch.randperm(count)
    patches = -(-count // 16)
    size = -(-count // patches)
    expected = torch.empty(2, count, 64)
    for b in range(2):
        for start in range(0, count, size):
            members = order[start:start + size]
            assert len(members) <= 16
            for row in members:
                heads = []
                for head in range(2):
                    part = slice(32 * head, 32 * head + 32)
                    query = layer.enter(x[b, row])[:64][part]
                    keys = torch.stack([layer.enter(x[b, k])[64:128][part] for k in members])
                    values = torch.stack([layer.enter(x[b, k])[128:][part] for k in members])
                    heads.append(((keys @ query) / 32 ** 0.5).softmax(0) @ values)
                expected[b, row] = layer.leave(torch.cat(heads))
    np.testing.assert_allclose(layer(x, order).detach(), expected.detach(), atol=1e-5)


def test_vector_attention_has_a_weight_for_each_channel():
    """Equations 8 to 10, with a softmax over the perceptron of equation 9, whose first layer is `first`."""
    torch.manual_seed(1)
    layer = networks.VectorAttention(8)
    asked, codes, near, offset = torch.randn(2, 6, 8), torch.randn(2, 9, 8), torch.randint(0, 9, (6, 4)), \
        torch.randn(6, 4, 8)
    expected = torch.empty(2, 6, 8)
    for b in range(2):
        for j in range(6):
            scores, values = [], []
            for k in range(4):
                code = codes[b, near[j, k]]
                relation = layer.query(asked[b, j]) - layer.key(code) + layer.offset(offset[j, k])
                scores.append(layer.weigh(relation.relu()))
                values.append(layer.value(code) + offset[j, k])
            for channel in range(8):
                weights = torch.stack([score[channel] for score in scores]).softmax(0)
                expected[b, j, channel] = sum(w * v[channel] for w, v in zip(weights, values, strict=True))
    np.testing.assert_allclose(layer(asked, codes, near, offset).detach(), expected.detach(), atol=1e-5)


def test_the_order_of_the_scene_points_does_not_matter_up_to_where_sampling_starts(room, model):
    points, queries = room
    whole = irradiance(model, points, queries)
    assert whole.shape == (60, 3) and np.isfinite(whole).all() and (whole > 0).all() and whole.std() > 0.01
    mixed = np.random.default_rng(0).permutation(len(points))
    shuffled = points[mixed]
    again = shuffled[farthest(shuffled[:, :3].astype(np.float64), len(points), int(np.flatnonzero(mixed == 0)[0]))]
    np.testing.assert_allclose(irradiance(model, again, queries), whole, rtol=2e-4)


def test_queries_do_not_matter_to_each_other(room, model, monkeypatch):
    points, queries = room
    whole = irradiance(model, points, queries)
    monkeypatch.setattr(embedding_bake, "QUERIES_AT_ONCE", 7)
    np.testing.assert_allclose(irradiance(model, points, queries), whole, rtol=1e-4)
    np.testing.assert_allclose(irradiance(model, points, queries[::-1]), whole[::-1], rtol=1e-4)
    assert irradiance(model, points, queries[:0]).shape == (0, 3)


def test_light_is_linear_and_channels_are_apart(room, model):
    points, queries = room
    whole = irradiance(model, points, queries)
    bright, turned, dark = points.copy(), points.copy(), points.copy()
    bright[:, 9:] *= 1000
    turned[:, 6:9], turned[:, 9:] = points[:, [7, 8, 6]], points[:, [10, 11, 9]]
    dark[:, 10] = 0
    np.testing.assert_allclose(irradiance(model, bright, queries), 1000 * whole, rtol=1e-3)
    turned_queries = queries[:, [0, 1, 2, 3, 4, 5, 7, 8, 6]]
    np.testing.assert_allclose(irradiance(model, turned, turned_queries), whole[:, [1, 2, 0]], rtol=1e-3)
    found = irradiance(model, dark, queries)
    assert (found[:, 1] == 0).all()
    np.testing.assert_allclose(found[:, ::2], whole[:, ::2], rtol=1e-3)


def test_a_room_may_stand_anywhere(room, model):
    points, queries = (each.astype(np.float64) for each in room)
    whole = irradiance(model, points, queries)
    for each in (points, queries):
        each[:, :3] += [400, -300, 8]
    np.testing.assert_allclose(irradiance(model, points, queries), whole, rtol=1e-3)


def test_a_room_turned_or_mirrored_has_the_same_layout(room):
    points = room[0][:, :3].astype(np.float64)
    here = embedding.layout(points, 2, 6, 4)
    for matrix in (Rotation.random(random_state=1).as_matrix(), np.diag([-1, 1, 1])):
        there = embedding.layout(points @ matrix.T, 2, 6, 4)
        for one, two in zip(here.gathered + here.around + here.above, there.gathered + there.around + there.above,
                            strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("points", [
    np.ones((1, 12)), np.ones((300, 12)), np.ones((3, 12)), np.eye(12)[:5], np.zeros((40, 12)),
    np.concatenate([np.random.default_rng(0).random((50, 9)), np.zeros((50, 3))], 1)],
    ids=["one point", "one place", "fewer than k", "few", "black", "no emitter"])
@pytest.mark.parametrize("settings", [TINY, networks.SMALL], ids=["tiny", "small"])
def test_degenerate_rooms_have_numbers_and_are_dark_where_nothing_shines(points, settings):
    queries = np.random.default_rng(1).random((9, 9))
    found = irradiance(network(settings), points.astype(np.float32), queries)
    assert np.isfinite(found).all() and (found >= 0).all()
    assert (found[:, points[:, 9:].sum(0) == 0] == 0).all()


def test_no_surface_at_all_is_refused(model):
    with pytest.raises(UserError, match="no surface"):
        embedding_bake.Room(model, np.zeros((0, 12), np.float32))


def test_weights_that_were_saved_are_those_that_are_asked(room, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(UserError, match=r"embedding\.safetensors' are missing"):
        embedding_bake.network()
    made = network(networks.SMALL)
    weights.save(tmp_path / weights.EMBEDDING, {name: value.numpy() for name, value in made.state_dict().items()})
    np.testing.assert_array_equal(irradiance(embedding_bake.network().cpu(), *room), irradiance(made, *room))


def test_without_torch_one_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match="needs PyTorch.*pip install torch"):
        embedding_bake.network()


def test_too_large_a_room_is_refused_with_its_size(room, model):
    points = room[0].copy()
    points[0, 0] += 30
    with pytest.raises(UserError, match=r"3\d\.\d m long.*up to 20 m"):
        embedding_bake.Room(model, points)


def test_an_untrained_network_gives_the_level_of_an_integrating_sphere():
    """Of which all is half white, and a fifth of the surface emits: pi e / 5 / (1 - 1 / 2); and half of the direct."""
    torch.manual_seed(0)
    turns, rise = np.arange(1000) * np.pi * (3 - 5 ** 0.5), 1 - (2 * np.arange(1000) + 1) / 1000
    round_ = np.sqrt(1 - rise ** 2)
    positions = np.stack([round_ * np.cos(turns), round_ * np.sin(turns), rise], 1)
    emission = (rise > 0.6)[:, None] * np.array([1, 2, 3])
    points = np.concatenate([positions, -positions, np.full((1000, 3), 0.5), emission], 1)
    queries = points[::50, :9]
    found = irradiance(networks.Embedding(TINY).eval(), points, queries)
    np.testing.assert_allclose(found, [np.pi * np.array([1, 2, 3]) / 5 * (2 + 0.5)] * len(queries), rtol=0.08)


def test_direct_light_is_that_of_a_disc():
    """On a disc's axis pi R^2 / (R^2 + d^2), by Lambert; from far off, of any lamps, a sum over cosines."""
    up, down = torch.tensor([[0, 0, 1.0]]), torch.tensor([[0, 0, -1.0]])
    for distance in (0.0, 1e-3, 0.1, 1.0, 7.0):
        found = networks.direct(torch.zeros(1, 3), up, up * distance, down, torch.tensor([2.0]), torch.tensor([[3.0]]))
        expected = 3 * 2 / (2 / np.pi + distance ** 2) if distance else 0
        np.testing.assert_allclose(found, [[expected]], rtol=1e-5)
    rng = np.random.default_rng(0)
    places, lamps = rng.random((9, 3)) * 4, rng.random((7, 3)) * 4 + [0, 0, 40]
    normals, turned = (v / np.linalg.norm(v, axis=1)[:, None] for v in (rng.normal(size=(n, 3)) for n in (9, 7)))
    areas, emission = rng.random(7) * 0.1, rng.random((2, 7))
    found = networks.direct(*(torch.from_numpy(each) for each in (places, normals, lamps, turned, areas, emission)))
    for j in range(9):
        total = np.zeros(2)
        for lamp in range(7):
            way = lamps[lamp] - places[j]
            length = np.linalg.norm(way)
            cosines = max(way @ normals[j], 0) * max(-way @ turned[lamp], 0) / length ** 2
            total += emission[:, lamp] * areas[lamp] * cosines / length ** 2
        np.testing.assert_allclose(found[:, j], total, rtol=1e-4)


def test_many_lamps_are_stood_for_by_the_first(monkeypatch):
    monkeypatch.setattr(networks, "LAMPS", 3)
    emission = torch.tensor([[0, 1, 0, 2, 0, 0, 0], [0, 0, 0, 0, 3, 4, 0.0]])
    rows, areas = networks.shining(emission, torch.tensor([9, 1, 9, 1, 1, 3, 9.0]))
    assert rows.tolist() == [1, 3, 4] and areas.tolist() == [2, 2, 2]
    assert networks.shining(emission * 0, torch.ones(7))[0].tolist() == []


def test_areas_are_of_what_points_stand_for_whatever_their_density():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(1200, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    sphere = sphere[farthest(sphere, 150)]
    found = embedding.areas(np.concatenate([sphere * 5, sphere + [9, 9, 9]])) / (4 * np.pi)
    assert 0.75 * 25 < found[:150].sum() < 1.25 * 25 and 0.75 < found[150:].sum() < 1.25
    assert (embedding.areas(np.ones((7, 3))) == 0).all() and embedding.areas(np.ones((1, 3))).tolist() == [0]


def asked(model, room):
    """The decoder's answer, with gradients."""
    points, queries = (torch.from_numpy(each) for each in room)
    settings = model.settings
    places = torch.from_numpy(embedding.normalised(points[:, :3].numpy(), points[:, :3].numpy()))
    layout = networks.Layout.of(embedding.layout(points[:, :3].numpy(), len(settings.depths), settings.gathered,
                                                 settings.around), torch.device("cpu"))
    orders = [torch.from_numpy(each) for each in embedding.orders(places.numpy(), len(settings.depths))]
    areas = torch.from_numpy(embedding.areas(points[:, :3].numpy()))
    codes = model.encoder(places, points[:, 3:6], areas, points[:, 6:9].T, points[:, 9:].T, torch.ones(3, 150), layout,
                          orders)
    near = embedding.nearest_to(queries[:, :3].numpy(), points[:codes.shape[1], :3].numpy(), settings.neighbours)
    return model.decoder(codes, places[:codes.shape[1]],
                         torch.from_numpy(embedding.normalised(queries[:, :3].numpy(), points[:, :3].numpy())),
                         queries[:, 3:6], queries[:, 6:].T, torch.ones(3, 60), torch.from_numpy(near))


def test_every_weight_is_learned_from(room):
    model = network().train()
    torch.manual_seed(0)
    asked(model, room).square().mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 1e-7, name


def test_curves_are_shuffled_in_training_alone_and_by_the_seed(room):
    model = network()
    assert torch.equal(asked(model, room), asked(model, room))
    model.train()
    answers = []
    for seed in (0, 0, 1, 2, 3):
        torch.manual_seed(seed)
        answers.append(asked(model, room))
    assert torch.equal(answers[0], answers[1])
    assert any(not torch.allclose(answers[0], other, rtol=1e-4) for other in answers[2:])
    for one, two in zip(network().parameters(), network().parameters(), strict=True):
        assert torch.equal(one, two)


def test_the_full_configuration_is_the_papers():
    """Table 3."""
    full = networks.FULL
    assert (full.width, full.gathered, full.patch, full.layers, full.neighbours) == (128, 32, 1024, 6, 32)
    assert full.depths == (2, 2, 2, 6, 2) and full.channels == (128, 128, 128, 256, 256) and full.dropout == 0.1
    model = networks.Embedding(full)
    assert model.encoder.blocks[0].attention.heads == 4 and model.decoder.mix[0][0].out_features == 512
    assert serialise.CURVES == 4 and len(model.encoder.blocks) == 14
