# SPDX-License-Identifier: GPL-3.0-or-later
"""The light-transport embedding: layers against loops over the paper's equations, and what holds for any room."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding, embedding_bake, serialise  # noqa: E402
from neural_gash_addon.backend.lit_points import LitPoints  # noqa: E402
from neural_gash_addon.backend.lit_scene import LitScene  # noqa: E402
from neural_gash_addon.backend.methods import run  # noqa: E402
from neural_gash_addon.backend.networks import embedding as networks  # noqa: E402

TINY = networks.Settings(first=16, widths=(32, 32, 64), hidden=16, gathered=6, around=4, patch=16, neighbours=5,
                         layers=2)
POINTS = 150


@pytest.fixture(scope="module")
def room():
    """Lit points of a box in farthest-point order; 60 queries: points, normals, direct light."""
    rng = np.random.default_rng(3)
    size, count = np.array([5, 4, 2.5]), 400
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    positions = rng.random((count, 3)) * size + 1
    positions[np.arange(count), axis] = 1 + side * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = 1 - 2 * side
    near = np.exp(-np.square(positions - [3.5, 3, 3.5]).sum(1))[:, None]
    direct, indirect = near * [20, 15, 10], rng.gamma(1, 1, (count, 3)) * (near + 0.3) * [3, 2, 1]
    chosen = farthest(positions, POINTS)
    points = LitPoints(*(each[chosen].astype(np.float32)
                         for each in (positions, normals, rng.random((count, 3)) * 0.8,
                                      np.where(rng.random((count, 1)) < 0.1, direct, 0), direct, indirect)))
    return points, tuple(each[-60:].astype(np.float32) for each in (positions, normals, direct))


def box_room(outwards=False):
    """A box of 4 by 3 by 2.5 metres, its sides inwards unless `outwards`, with a lamp below the ceiling."""
    size = np.array([4, 3, 2.5])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    triangles = triangles if outwards else triangles[:, ::-1]
    lamp = np.array([[1.7, 1.2, 2.45], [1.7, 1.7, 2.45], [2.2, 1.7, 2.45], [2.2, 1.2, 2.45]])
    positions = np.concatenate([corners, lamp])
    triangles = np.concatenate([triangles, [[8, 9, 10], [8, 10, 11]]]).astype(np.int32)
    albedo = np.full((14, 3), 0.6)
    albedo[:2] = [0.8, 0.2, 0.1]
    emission = np.zeros((14, 3))
    emission[12:] = [20, 18, 15]
    return LitScene(positions, triangles, albedo, emission)


QUERIES = (np.array([[1.0, 1, 0], [3, 2, 0], [0, 1.5, 1], [2, 3, 2]]),
           np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0], [0, -1, 0]]))


@pytest.fixture(scope="module")
def model():
    return network()


def network(settings=TINY, seed=0):
    """One in which no layer is at zero, as after training."""
    torch.manual_seed(seed)
    made = networks.Embedding(settings)
    for parameter in made.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.3)
    torch.nn.init.normal_(made.decoder.weigh.weight, std=0.3)
    return made.eval()


def farthest(points, count, first=0):
    """Rows of farthest point sampling, as it is defined: each time the point farthest from those taken."""
    chosen = [first]
    while len(chosen) < count:
        away = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(1)
        chosen.append(int(away.argmax()))
    return chosen


def reflected(model, points, queries):
    return run(embedding_bake.Room(model, points).reflected(*queries))


def changed(points, **fields):
    return LitPoints(**{**vars(points), **{name: value.astype(np.float32) for name, value in fields.items()}})


def test_the_layout_is_of_nearest_points(room):
    points = room[0].places.astype(np.float64)
    found = embedding.layout(points, (2, 2), 6, 4)
    half, quarter = found.halvings
    for rows, of in ((found.gathered, points), (half, points), (quarter, points[:75]), (found.around, points[:38])):
        away = cKDTree(of).query(points[:len(rows)], rows.shape[1])[0]
        np.testing.assert_allclose(np.linalg.norm(points[rows] - points[:len(rows), None], axis=2), away, rtol=1e-6)
    assert found.gathered.shape == (38, 6) and found.around.shape == (38, 4) and found.areas.shape == (POINTS,)
    assert half.shape == (75, 6) and quarter.shape == (38, 6)
    assert (np.sort(found.orders, 1) == np.arange(38)).all() and len(found.orders) == serialise.CURVES


def test_areas_are_of_what_points_stand_for_whatever_their_density():
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(1200, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    sphere = sphere[farthest(sphere, 150)]
    found = embedding.areas(np.concatenate([sphere * 5, sphere + [9, 9, 9]])) / (4 * np.pi)
    assert 0.75 * 25 < found[:150].sum() < 1.25 * 25 and 0.75 < found[150:].sum() < 1.25
    assert (embedding.areas(np.ones((7, 3))) == 0).all() and embedding.areas(np.ones((1, 3))).tolist() == [0]


def test_relations_are_heights_distances_and_a_cosine():
    rng = np.random.default_rng(0)
    places, normals, others, turned = (rng.normal(size=shape) for shape in ((4, 3), (4, 3), (4, 5, 3), (4, 5, 3)))
    spacing = rng.random((4, 5)) + 0.5
    found = networks.relation(*(torch.from_numpy(each) for each in (places, normals, others, turned, spacing)))
    for j in range(4):
        for k in range(5):
            way = (others[j, k] - places[j]) / spacing[j, k]
            far = np.linalg.norm(way)
            np.testing.assert_allclose(found[j, k], [way @ normals[j], way @ turned[j, k], far, np.log(1 + far ** 2),
                                                     normals[j] @ turned[j, k]], rtol=1e-9)


def test_surroundings_are_a_depthwise_convolution():
    torch.manual_seed(0)
    layer = networks.Surroundings(6)
    x, lie, around = torch.randn(2, 9, 6), torch.randn(9, 4, networks.RELATION), torch.randint(0, 9, (9, 4))
    expected = torch.zeros(2, 9, 6)
    for b in range(2):
        for row in range(9):
            for k in range(4):
                expected[b, row] += x[b, around[row, k]] * layer.kernel(lie[row, k]) / 4
    np.testing.assert_allclose(layer(x, lie, around).detach(), layer.norm(layer.leave(expected)).detach(), atol=1e-5)


def test_a_halving_is_the_greatest_of_what_points_about_a_point_are_beside_it(room):
    """Equations 2 and 3 one neighbour at a time, the concatenation's matrix in its two parts."""
    torch.manual_seed(0)
    layer, frame = networks.Halving(6, 8), frame_of(room[0])
    near, x = frame.halvings[1], torch.randn(2, 75, 6)
    expected = torch.empty(2, 38, 8)
    for b in range(2):
        for row in range(38):
            spacing = (frame.areas[row] * POINTS / 38).sqrt()
            each = []
            for k in near[row]:
                way = (frame.places[k] - frame.places[row]) / spacing
                lie = torch.stack([way @ frame.normals[row], way @ frame.normals[k], way.norm(),
                                   way.square().sum().log1p(), frame.normals[k] @ frame.normals[row]])
                each.append(layer.difference(x[b, k] - x[b, row]) + layer.centre(x[b, row]) + layer.offset(lie))
            expected[b, row] = torch.nn.functional.gelu(layer.norm(torch.stack(each).amax(0)))
    found = layer(x, near, frame.lie(near))
    np.testing.assert_allclose(found.detach(), expected.detach(), rtol=1e-4, atol=1e-4)


def test_a_code_gathers_from_points_about_points_about_it(room, model):
    """Halving by halving: what a scene point carries reaches just the codes that have it in reach."""
    frame = frame_of(room[0])
    first, second = (each.numpy() for each in frame.halvings)
    carried, beside = torch.rand(1, POINTS, 5), torch.zeros(1, 38, 3 * networks.POOLS)
    before = model.encoder.embed(frame, carried, beside)
    reached = np.zeros(38, bool)
    for point in range(0, POINTS, 10):
        other = carried.clone()
        other[0, point] += 5
        changed_codes = (model.encoder.embed(frame, other, beside) != before).any(2)[0].numpy()
        can = np.isin(second, np.flatnonzero((first == point).any(1) | (np.arange(75) == point))).any(1)
        assert not (changed_codes & ~can).any()
        reached |= changed_codes & ~(frame.gathered.numpy() == point).any(1)
    assert reached.any()  # from farther than the k nearest


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


def test_the_decoder_is_vector_attention(room, model):
    """Equations 8 to 10 one code at a time, layer by layer; and the mean of light by the first of the weights."""
    decoder, rng = model.decoder, torch.Generator().manual_seed(0)
    frame = frame_of(room[0])
    codes = networks.Codes(*(torch.randn(2, 38, *size, generator=rng) for size in ((), (16,), (16,))), tuple(
        tuple(torch.randn(2, 2, 38, 16, generator=rng)) for _ in decoder.further))
    places, normals = (torch.from_numpy(each[:6]) for each in room[1][:2])
    (albedo, direct), near = torch.rand(2, 2, 6, generator=rng), torch.randint(0, 38, (6, 5), generator=rng)
    expected = torch.empty(2, 6)
    for b in range(2):
        for j in range(6):
            asks, kept = decoder.asks(torch.stack([direct[b, j].log1p(), albedo[b, j]])).chunk(2)
            scores, values, own, light = [], [], [], []
            for k in near[j]:
                lie = networks.relation(places[j:j + 1], normals[j:j + 1], frame.places[k][None, None],
                                        frame.normals[k][None, None], frame.spacing[k][None, None])
                relates, offset = decoder.lie(lie)[0, 0].chunk(2)
                score = decoder.weigh((asks + codes.key[b, k] + relates).relu())
                own.append(score[0] + decoder.kernel(lie)[0, 0, 0])
                scores.append(score[1:])
                values.append(codes.value[b, k] + offset)
                light.append(codes.light[b, k])
            latent = kept + (torch.stack(scores).softmax(0) * torch.stack(values)).sum(0)
            for layer, (keys, kept_values) in zip(decoder.further, codes.further, strict=True):
                asks, scores, values = layer.asks(layer.norms[0](latent)), [], []
                for k in near[j]:
                    lie = networks.relation(places[j:j + 1], normals[j:j + 1], frame.places[k][None, None],
                                            frame.normals[k][None, None], frame.spacing[k][None, None])
                    relates, offset = layer.lie(lie)[0, 0].chunk(2)
                    scores.append(layer.weigh((asks + keys[b, k] + relates).relu()))
                    values.append(kept_values[b, k] + offset)
                latent = latent + (torch.stack(scores).softmax(0) * torch.stack(values)).sum(0)
                latent = latent + layer.mix(layer.norms[1](latent))
            factor = (2 * torch.tanh(decoder.finish(latent) / 2)).exp()
            expected[b, j] = (torch.stack(own).softmax(0) * torch.stack(light)).sum() * factor
    found = decoder(codes, frame, places, normals, albedo, direct, near)
    np.testing.assert_allclose(found.detach(), expected.detach(), rtol=1e-4, atol=1e-5)


def frame_of(points, settings=TINY):
    return networks.Frame.of(torch.from_numpy(points.places), torch.from_numpy(points.normals),
                             embedding.layout(points.places, settings.halvings, settings.gathered, settings.around))


def test_the_order_of_the_scene_points_does_not_matter_up_to_where_sampling_starts(room, model):
    points, queries = room
    whole = reflected(model, points, queries)
    assert whole.shape == (60, 3) and np.isfinite(whole).all() and (whole > 0).all() and whole.std() > 0.01
    mixed = np.random.default_rng(0).permutation(POINTS)
    places = points.places[mixed].astype(np.float64)
    again = mixed[farthest(places, POINTS, int(np.flatnonzero(mixed == 0)[0]))]
    shuffled = LitPoints(*(each[again] for each in vars(points).values() if each is not None))
    np.testing.assert_allclose(reflected(model, shuffled, queries), whole, rtol=2e-4)


def test_queries_do_not_matter_to_each_other(room, model, monkeypatch):
    points, queries = room
    whole = reflected(model, points, queries)
    monkeypatch.setattr(embedding_bake, "QUERIES_AT_ONCE", 7)
    np.testing.assert_allclose(reflected(model, points, queries), whole, rtol=1e-4)
    np.testing.assert_allclose(reflected(model, points, [each[::-1] for each in queries]), whole[::-1], rtol=1e-4)
    assert reflected(model, points, [each[:0] for each in queries]).shape == (0, 3)
    dark = queries[1].copy()
    dark[5] = 0
    assert (reflected(model, points, (queries[0], dark, queries[2]))[5] == 0).all()


def test_light_is_linear_and_channels_are_apart(room, model):
    points, (places, normals, direct) = room
    whole = reflected(model, points, (places, normals, direct))

    def lit(give):
        return reflected(model, changed(points, emission=give(points.emission), direct=give(points.direct),
                                        indirect=give(points.indirect)),
                         (places, normals, give(direct)))

    for factor in (2.0 ** -20, 2.0 ** 20):  # by powers of two nothing is rounded otherwise
        np.testing.assert_array_equal(lit(lambda light, factor=factor: light * np.float32(factor)), whole * factor)
    np.testing.assert_allclose(lit(lambda light: light * np.float32([1000, 1, 0.001])), whole * [1000, 1, 0.001],
                               rtol=1e-3)
    dark = lit(lambda light: light * np.float32([1, 0, 1]))
    assert (dark[:, 1] == 0).all()
    np.testing.assert_allclose(dark[:, ::2], whole[:, ::2], rtol=1e-4)
    turn = [1, 2, 0]
    turned = reflected(model, LitPoints(points.places, points.normals, points.albedo[:, turn],
                                        points.emission[:, turn], points.direct[:, turn],
                                        points.indirect[:, turn]), (places, normals, direct[:, turn]))
    np.testing.assert_allclose(turned, whole[:, turn], rtol=1e-4)


def moved(room, matrix, away=(40, -30, 8)):
    """The room elsewhere, and what is asked of it."""
    points, (places, normals, direct) = room
    turn = matrix / np.cbrt(abs(np.linalg.det(matrix)))
    return (changed(points, places=points.places @ matrix.T + away, normals=points.normals @ turn.T),
            (places @ matrix.T + away, normals @ turn.T, direct))


@pytest.mark.parametrize("matrix", [Rotation.random(random_state=1).as_matrix(), np.diag([-1, 1, 1])],
                         ids=["turned", "mirrored"])
def test_a_room_may_stand_anywhere(room, matrix):
    """Where all codes are of one patch; along other curves there would be other patches."""
    model = network(networks.Settings(**{**vars(TINY), "patch": 64}))
    np.testing.assert_allclose(reflected(model, *moved(room, matrix)), reflected(model, *room), rtol=2e-3)


def test_lengths_are_read_by_one_fixed_scale_as_far_as_training_had_them(room):
    """A larger room is another one; beyond what was trained with, rooms are as the largest, or the smallest."""
    model = network(networks.Settings(**{**vars(TINY), "patch": 64}))
    sizes = {size: reflected(model, *moved(room, size * np.eye(3), [0, 0, 0]))
             for size in (1e-3, 0.01, 0.1, 0.15, 0.2, 2, 40)}
    for one, other in ((1e-3, 0.01), (2, 40)):
        np.testing.assert_allclose(sizes[one], sizes[other], rtol=2e-3)
    for one, other in ((0.01, 0.1), (0.1, 0.15), (0.15, 0.2), (0.2, 2)):
        assert np.abs(sizes[one] / sizes[other] - 1).max() > 0.005


def test_the_albedo_of_a_query_is_that_of_what_it_lies_on(room):
    """Of the nearest scene point that faces as it does, not of another side of a thin wall; and it is read."""
    thin = np.array([[0, 0, 0.0], [0, 0, -0.01], [0.3, 0, 0], [0.3, 0, -0.01]])
    surface = np.concatenate([thin, [[0, 0, 1.0], [0, 0, -1]] * 2, np.arange(12).reshape(4, 3) / 12], 1)
    asked = np.array([[0.02, 0, -0.006], [0.2, 0, -0.006], [0.2, 0, 0.5]]), [[0, 0, 1.0], [0, 0, -1], [1, 0, 0]]
    found = embedding.colours(asked[0], np.array(asked[1]), np.zeros(3, int), np.array([[0, 1, 2, 3]]), surface)
    np.testing.assert_allclose(found, surface[[0, 3, 2], 6:])  # none faces as the last
    points, queries = room
    places, normals = queries[:2]
    surface = np.concatenate([points.places, points.normals, points.albedo], 1)
    layout = embedding.layout(points.places, TINY.halvings, 32, TINY.around)
    codes = cKDTree(points.places[:38]).query(places)[1]
    expected = []
    for place, normal, code in zip(places, normals, codes, strict=True):
        about = sorted(layout.gathered[code], key=lambda k: np.linalg.norm(points.places[k] - place))
        expected.append(next((k for k in about if points.normals[k] @ normal > 0.5), about[0]))
    found = embedding.colours(places, normals, codes, layout.gathered, surface)
    np.testing.assert_array_equal(found, points.albedo[expected])
    every = [next(k for k in row if points.normals[k] @ normal > 0.5)
             for row, normal in zip(cKDTree(points.places).query(places, POINTS)[1], normals, strict=True)]
    assert np.mean(np.array(expected) == every) > 0.95  # of all scene points hardly another one is
    model = network()
    whole = reflected(model, points, queries)
    made = embedding_bake.Room(model, points)
    made._surface = np.concatenate([points.places, points.normals, 1 - points.albedo], 1)
    assert np.abs(run(made.reflected(*queries)) / whole - 1).max() > 0.01


def points_of(array):
    array = array.astype(np.float32)
    return LitPoints(*(array[:, at:at + 3] for at in range(0, 18, 3)))


@pytest.mark.parametrize("array", [
    np.ones((1, 18)), np.ones((300, 18)), np.ones((3, 18)), np.eye(18)[:5], np.zeros((40, 18)),
    np.concatenate([np.random.default_rng(0).random((50, 12)), np.zeros((50, 6))], 1)],
    ids=["one point", "one place", "fewer than k", "few", "black", "no light"])
@pytest.mark.parametrize("settings", [TINY, networks.SMALL], ids=["tiny", "small"])
def test_degenerate_rooms_have_numbers_and_are_dark_where_there_is_no_light(array, settings):
    points, rng = points_of(array), np.random.default_rng(1)
    found = reflected(network(settings), points, rng.random((3, 9, 3)))
    assert np.isfinite(found).all() and (found >= 0).all()
    assert (found[:, points.indirect.sum(0) == 0] == 0).all()


def test_before_training_it_is_a_mean_of_the_scene_points(room):
    """Of one light everywhere that is this light, and of any between the least and the greatest."""
    points, queries = room
    model = networks.Embedding(TINY).eval()
    same = changed(points, indirect=np.full((POINTS, 3), 2.5))
    np.testing.assert_allclose(reflected(model, same, queries), 2.5, rtol=1e-4)
    found = reflected(model, points, queries)
    assert (found > points.indirect.min(0)).all() and (found < points.indirect.max(0)).all()


def asked(model, room):
    """The network's answer, with gradients."""
    points, (places, normals, direct) = room
    frame = frame_of(points, model.settings)
    light = [torch.from_numpy(each).T for each in (points.albedo, np.pi * points.emission, points.direct,
                                                   points.indirect)]
    near = embedding.nearest_to(places, points.places[:38], model.settings.neighbours)
    return model.decoder(model.encoder(frame, *light), frame, torch.from_numpy(places), torch.from_numpy(normals),
                         torch.linspace(0, 1, 3 * len(places)).view(3, -1), torch.from_numpy(direct).T,
                         torch.from_numpy(near))


def test_every_weight_is_learned_from(room):
    model = network().train()
    torch.manual_seed(0)
    asked(model, room).square().mean().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 1e-7, name


def test_dropout_acts_in_training_alone(room):
    """With one curve to walk, so that nothing else is drawn."""
    dropping = network(networks.Settings(**{**vars(TINY), "dropout": 0.3}))
    assert torch.equal(asked(dropping, room), asked(dropping, room))
    assert torch.equal(asked(dropping, room), asked(network(), room))
    orders = {}

    def unshuffled(count, orders=orders):
        return orders.setdefault(count, torch.arange(count))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks.torch, "randperm", unshuffled)
        still, dropping = network().train(), dropping.train()
        assert torch.equal(asked(still, room), asked(still, room))
        assert not torch.allclose(asked(dropping, room), asked(dropping, room), rtol=1e-3)


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
